"use strict";
// Tables of parameters as CSV: to the clipboard, or as a file.
for (const button of document.querySelectorAll("button[data-csv]")) {
  const table = document.getElementById(button.dataset.csv);
  const cell = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const csv = () => [...table.rows].map((row) => [...row.cells].map((c) => cell(c.dataset.value || c.textContent.trim())).join(",")).join("\n") + "\n";
  button.addEventListener("click", async () => {
    const label = button.textContent;
    if (button.dataset.to === "file") {
      const link = document.createElement("a");
      link.href = "data:text/csv;charset=utf-8," + encodeURIComponent(csv());
      link.download = button.dataset.csv + ".csv";
      link.click();
    } else {
      try { await navigator.clipboard.writeText(csv()); button.textContent = "copied"; } catch { button.textContent = "not allowed here: download it"; }
      setTimeout(() => { button.textContent = label; }, 2000);
    }
  });
}
