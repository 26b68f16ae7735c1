"use strict";
// plotly.js is unpacked only when the first plot is wanted, so that the page itself opens at once.
let unpacked = null;
const unpackPlotly = () => {
  unpacked = unpacked || (async () => {
    const bytes = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  })();
  return unpacked;
};
