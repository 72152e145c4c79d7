"use strict";
(() => {
  const charts = [...document.querySelectorAll(".chart")].map(box => ({ box, text: box.querySelector("script").textContent }));
  for (const { box } of charts) box.replaceChildren();
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  function draw() {
    const colours = { "@fg": colour("--fg"), "@muted": colour("--muted"), "@grid": colour("--grid") };
    for (const { box, text } of charts) {
      const figure = JSON.parse(text, (key, value) => colours[value] ?? value);
      Plotly.react(box, figure.data, figure.layout, { responsive: true, displaylogo: false, displayModeBar: false });
    }
  }
  draw();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => draw());
  matchMedia("print").addEventListener("change", () => { draw(); for (const { box } of charts) Plotly.Plots.resize(box); });
})();
