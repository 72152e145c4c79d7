"use strict";
// Draws a chart when it comes into view: neither the library nor the charts of closed sections cost the page's opening anything.
(() => {
  const boxes = [...document.querySelectorAll(".chart")];
  const drawn = new Set();
  let figures = [];
  let loaded = null;
  function expanded(id) {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), letter => letter.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }
  function library() {
    loaded ??= (async () => {
      figures = (await expanded("charts")).split("\n");
      const script = document.createElement("script");
      script.textContent = await expanded("plotly");
      document.head.append(script);
    })();
    return loaded;
  }
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  function draw(box) {
    const colours = { "@fg": colour("--fg"), "@muted": colour("--muted"), "@grid": colour("--grid") };
    const figure = JSON.parse(figures[box.dataset.chart], (key, value) => colours[value] ?? value);
    box.querySelector(".still")?.remove();
    Plotly.react(box, figure.data, figure.layout, { responsive: true, displaylogo: false, displayModeBar: false });
    drawn.add(box);
  }
  const seen = new IntersectionObserver(entries => {
    const coming = entries.filter(entry => entry.isIntersecting).map(entry => entry.target);
    for (const box of coming) seen.unobserve(box);
    if (coming.length) library().then(() => coming.forEach(draw));
  }, { rootMargin: "300px" });
  for (const box of boxes) seen.observe(box);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drawn.forEach(draw));
  // Print what is open, in the print's colours and width: `printed` lays the page out so before a chart asks how wide it is.
  const shown = box => !box.closest("details:not([open])");
  const redraw = () => window.Plotly && boxes.filter(shown).forEach(box => { Plotly.purge(box); draw(box); });
  addEventListener("beforeprint", () => { document.documentElement.classList.add("printed"); redraw(); });
  addEventListener("afterprint", () => { document.documentElement.classList.remove("printed"); redraw(); });
  // What scrolls sideways can be scrolled by keyboard, too.
  const reach = () => document.querySelectorAll("table, .scroll").forEach(one => {
    if (one.scrollWidth > one.clientWidth) one.tabIndex = 0; else one.removeAttribute("tabindex");
  });
  document.addEventListener("toggle", reach, true);
  addEventListener("resize", reach);
  reach();
  // A link to a section opens it.
  const reveal = () => {
    const target = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    for (let at = target; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
    if (target) target.scrollIntoView();
  };
  addEventListener("hashchange", reveal);
  reveal();
  document.getElementById("open-all")?.addEventListener("click", () => {
    for (const section of document.querySelectorAll("details.section")) section.open = true;
  });
})();
