"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const choice = document.getElementById("recording");
  const touch = matchMedia("(pointer: coarse)").matches;
  const root = document.documentElement;
  let printing = false;

  // A channel is a scale, an offset and 16-bit steps in base64; the lowest step stands for "no value".
  const decode = (channel) => {
    if (!channel) return null;
    const bytes = Uint8Array.from(atob(channel.d), (c) => c.charCodeAt(0));
    return Array.from(new Int16Array(bytes.buffer), (k) => (k === -32768 ? null : channel.o + channel.s * k));
  };
  const minus = (a, b) => a.map((x, k) => (x === null || b[k] === null ? null : x - b[k]));

  const colours = () => {
    const style = getComputedStyle(printing ? document.getElementById("paper") : root);
    return (name) => style.getPropertyValue("--" + name).trim();
  };

  const layout = (colour, extra) => {
    const axis = (title) => ({
      title: { text: title, font: { size: 12 }, standoff: 6 }, gridcolor: colour("line"), zerolinecolor: colour("line"),
      linecolor: colour("line"), automargin: true, tickfont: { size: 11 },
    });
    const built = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: false, hovermode: "closest",
      font: { family: getComputedStyle(document.body).fontFamily, color: colour("fine") },
      margin: { l: 52, r: 8, t: touch || printing ? 6 : 26, b: 38 }, dragmode: touch ? false : "zoom", shapes: extra.shapes,
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("noise"), activecolor: colour("ink") },
    };
    for (const [name, value] of Object.entries(extra.axes)) built[name] = { ...axis(value.text), ...value.options };
    return built;
  };

  const floor = (colour, level, axes) => [level, -level].map((y) => ({
    type: "line", xref: axes.x, yref: axes.y, x0: 0, x1: 1, y0: y, y1: y,
    line: { color: colour("noise"), width: 1.5, dash: "dash" },
  }));

  const againstTime = (joint, series, colour) => {
    const line = (name, y, key, more) => ({
      type: "scatter", mode: "lines", name, x: series.time, y, line: { color: colour(key), width: 1.5, ...more },
    });
    const below = { yaxis: "y2", xaxis: "x" };
    const traces = [];
    if (series.measured) traces.push(line("measured", series.measured, "measured", { width: 2.2 }));
    const last = series.before ? " after" : ""; // one model alone has no before
    if (series.before) traces.push(line("simulated before", series.before, "before", { dash: "dot" }));
    traces.push(line("simulated" + last, series.after, "after"));
    if (series.residualBefore) {
      traces.push({ ...line("residual before", series.residualBefore, "before", { width: 1.2 }), ...below });
    }
    if (series.measured) {
      traces.push({ ...line("residual" + last, series.residualAfter, "after", { width: 1.2 }), ...below });
    }
    const both = Boolean(series.measured);
    const axes = { xaxis: { text: "time, s", options: { anchor: both ? "y2" : "y" } } };
    axes.yaxis = { text: data.quantity + ", " + joint.unit, options: { domain: both ? [0.46, 1] : [0, 1] } };
    if (both) axes.yaxis2 = { text: "residual, " + joint.unit, options: { domain: [0, 0.4] } };
    return [traces, layout(colour, { axes, shapes: both ? floor(colour, joint.noise, { x: "paper", y: "y2" }) : [] })];
  };

  const against = (key, joint, series, colour) => {
    if (!series.measured) return [[], layout(colour, { axes: {}, shapes: [] })];
    const step = printing ? Math.ceil(series[key].length / 400) : 1; // a printer takes minutes over more
    const thin = (values) => values.filter((_, k) => k % step === 0);
    const points = (name, y, tone, symbol) => ({
      type: "scatter", mode: "markers", name, x: thin(series[key]), y: thin(y),
      marker: { color: colour(tone), size: 4, symbol, opacity: printing ? 1 : 0.6 },
    });
    const traces = [points("after", series.residualAfterShown || series.residualAfter, "after", "circle")];
    if (series.residualBefore) {
      traces.unshift(points("before", series.residualBeforeShown || series.residualBefore, "before", "circle-open"));
    }
    const text = key + ", " + (key === "velocity" ? joint.angle + "/s" : joint.angle);
    const axes = { xaxis: { text, options: {} }, yaxis: { text: "residual, " + joint.unit, options: {} } };
    return [traces, layout(colour, { axes, shapes: floor(colour, joint.noise, { x: "paper", y: "y" }) })];
  };

  const draw = (details, which = () => true) => {
    const library = window.Plotly;
    if (!library) throw new Error("no plotting library");
    const index = Number(details.dataset.joint);
    const stored = data.recordings[choice ? Number(choice.value) : 0][index];
    const series = Object.fromEntries(Object.entries(stored).map(([key, channel]) => [key, decode(channel)]));
    if (series.measured) {
      series.residualBefore = series.before && minus(series.measured, series.before);
      series.residualAfter = minus(series.measured, series.after);
    }
    const colour = colours();
    const range = printing ? null : details.shown;
    if (range) {
      const inside = series.time.map((t) => t >= range[0] && t <= range[1]);
      for (const key of ["residualBefore", "residualAfter"]) {
        if (series[key]) series[key + "Shown"] = series[key].map((x, k) => (inside[k] ? x : null));
      }
    }
    for (const plot of [...details.querySelectorAll(".plot")].filter(which)) {
      const kind = plot.dataset.plot;
      plot.closest("figure").hidden = kind !== "time" && !series.measured;
      const make = kind === "time" ? againstTime : against.bind(null, kind);
      const [traces, frame] = make(data.joints[index], series, colour);
      const options = {
        displaylogo: false, responsive: !printing, displayModeBar: touch || printing ? false : "hover",
        modeBarButtons: [["zoom2d", "pan2d", "resetScale2d", "toImage"]],
      };
      library.react(plot, traces, frame, options);
      if (kind === "time" && !plot.dataset.linked) {
        plot.dataset.linked = "";
        plot.on("plotly_relayout", (change) => follow(details, change));
      }
      if (printing) library.Plots.resize(plot);
    }
    details.dataset.drawn = "";
  };

  // A stretch of time that is zoomed into is the stretch that the plots beside it show.
  const follow = (details, change) => {
    const [from, to] = change["xaxis.range"] || [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    if (from === undefined && !change["xaxis.autorange"]) return;
    details.shown = from === undefined ? null : [from, to];
    attempt(details, (plot) => plot.dataset.plot !== "time");
  };

  const attempt = async (details, which) => {
    try {
      await unpackPlotly();
      draw(details, which);
    } catch (error) {
      document.getElementById("trouble").hidden = false;
      console.error(error);
    }
  };
  const all = [...document.querySelectorAll("details.joint")];
  const redraw = () => all.filter((details) => "drawn" in details.dataset).forEach((details) => attempt(details));

  const watcher = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (isIntersecting && target.open && !("drawn" in target.dataset)) attempt(target);
    }
  }, { rootMargin: "300px" });
  for (const details of all) {
    watcher.observe(details);
    details.addEventListener("toggle", () => details.open && !("drawn" in details.dataset) && attempt(details));
  }
  if (choice) choice.addEventListener("change", () => { all.forEach((d) => { d.shown = null; }); redraw(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

  const unfold = () => {
    const target = location.hash && document.getElementById(location.hash.slice(1));
    if (target && target.tagName === "DETAILS") target.open = true;
  };
  addEventListener("hashchange", unfold);
  unfold();

  addEventListener("load", () => setTimeout(unpackPlotly, 300)); // a print waits for nothing
  let closed = [];
  addEventListener("beforeprint", () => {
    printing = true;
    closed = [...document.querySelectorAll("details:not([open])")];
    closed.forEach((details) => { details.open = true; });
    root.classList.add("printing");
    all.forEach((details) => { if (window.Plotly) draw(details); else attempt(details); });
  });
  addEventListener("afterprint", () => {
    printing = false;
    closed.forEach((details) => { details.open = false; });
    root.classList.remove("printing");
    redraw();
  });
})();
