// One session as it grows: its newest frame with histogram and saturation, and the curves that the captures so far show.

import { chart, key, number } from "./charts.js";
import { $, ask, element } from "./page.js";

/** @typedef {import("./charts.js").Series} Series */
/** @typedef {import("./charts.js").Axis} Axis */

/** @type {Record<string, number>} */
const CHANNELS = { R: 0, G1: 1, G2: 1, Y: 1, B: 2 };
/** The id of the session.
 * @type {string | null} */
let watched = null;
let drawn = ""; // what stands there
let busy = false;
const PLACES = /** @type {const} */ (["watch-frame", "watch-figures", "watch-histogram", "transfer", "sensitivity", "edges"]);

/** @param {Model<"SessionDetail"> | null} session */
export function watch(session) {
  if (watched === session?.id) return;
  watched = session?.id ?? null;
  drawn = "";
  if (!session) return;
  $("watch-none").hidden = false;
  $("watch-step").textContent = $("watch-seen").textContent = "";
  for (const place of PLACES) $(place).replaceChildren();
}

// What the session that is shown does now.
document.addEventListener("session-progress", ({ detail: { id, words } }) => {
  if (id === watched) $("watch-step").textContent = words;
});

/** @param {number} value */
const share = (value) => (value === 0 ? "none" : value < 0.0001 ? "< 0.01 %" : `${number(100 * value, 3)} %`);

/** @param {Model<"StoredCapture">} capture @param {Model<"FrameFigures">} figures */
function drawFrame(capture, figures) {
  const picture = element("img", { src: `${capture.preview.replace(/png$/, "webp")}?width=640&stretch=true`, alt: `newest frame, ${capture.side} camera: ${capture.name}` });
  $("watch-frame").replaceChildren(picture, element("figcaption", { textContent: capture.name }));
  const series = figures.channels.map((one) => ({
    name: one.channel,
    colour: CHANNELS[one.channel],
    line: true,
    points: one.counts.map((count, bin) => [(bin + 0.5) * figures.bin_dn, count]),
  }));
  const worst = Math.max(...figures.channels.map((one) => one.saturated_share));
  const title = `Histogram of ${capture.name}: ${figures.channels.map((one) => `${one.channel} mean ${number(one.mean_dn, 4)} DN`).join(", ")}; saturated at most ${share(worst)}`;
  $("watch-histogram").replaceChildren(chart({ title, series, x: { label: "DN", from: 0, to: figures.bin_dn * series[0].points.length }, y: { label: "pixels", from: 0 } }));
  drawChannels("watch-figures", figures);
}

/** The mean and the saturated share of each channel, as rows of a table.
 * @param {"watch-figures" | "inspect-figures"} place @param {Model<"FrameFigures">} figures */
export function drawChannels(place, figures) {
  $(place).replaceChildren(
    ...figures.channels.map((one) =>
      element(
        "tr",
        {},
        element("td", {}, ...key([{ name: one.channel, colour: CHANNELS[one.channel] }])),
        element("td", { className: "number", textContent: `${number(one.mean_dn, 4)} DN` }),
        element("td", { className: "number" }, element("span", { className: one.saturated_share > 0.001 ? "mark warn" : "", textContent: share(one.saturated_share) })),
      ),
    ),
  );
}

/** Points of each channel, as a series.
 * @template {{channel: string}} Point
 * @param {Point[]} points
 * @param {(point: Point) => number[]} pair
 * @returns {Series[]} */
const byChannel = (points, pair) =>
  [...Map.groupBy(points, (p) => p.channel)].map(([name, of]) => ({ name, colour: CHANNELS[name], points: of.map(pair) }));

/** @param {Model<"Curves">} curves @param {string} side */
function drawCurves(curves, side) {
  const transfer = byChannel(curves.transfer.filter((p) => p.side === side && !p.saturated), (p) => [p.mean_dn, p.variance_dn2]);
  const light = curves.sensitivity.filter((p) => p.side === side);
  const most = Math.max(...light.map((p) => p.dn_per_s_and_radiance));
  const sensitivity = byChannel(light, (p) => [p.wavelength_nm, p.dn_per_s_and_radiance / most]);
  /** @type {Series[]} */
  const edges = curves.edges.filter((e) => e.side === side).map((e) => ({ name: e.region, colour: 1, line: true, points: e.frequency_cy_per_px.map((f, at) => [f, e.mtf[at]]) }));
  /** @type {["transfer" | "sensitivity" | "edges", Series[], string, Axis, Axis][]} */
  const parts = [
    ["transfer", transfer, "Photon transfer", { label: "mean above black, DN", log: true }, { label: "temporal variance, DN²", log: true }],
    ["sensitivity", sensitivity, "Relative sensitivity", { label: "wavelength, nm" }, { label: "of the largest", from: 0, to: 1 }],
    ["edges", edges, "MTF", { label: "cycles per pixel", from: 0, to: 0.5 }, { label: "contrast", from: 0, to: 1.1 }],
  ];
  for (const [place, series, name, x, y] of parts) {
    const count = series.reduce((sum, one) => sum + (one.line ? 1 : one.points.length), 0);
    const what = place === "edges" ? "edges" : "points";
    const caption = element("figcaption", {}, element("strong", { textContent: name }), ` ${count ? `${count} ${what}` : "nothing yet"} `);
    if (place !== "edges") caption.append(...key([...new Map(series.map((one) => [one.colour, { name: one.name.replace(/^G.$/, "G"), colour: one.colour }])).values()]));
    $(place).replaceChildren(...(count ? [chart({ title: `${name} of the ${side} camera, ${count} ${what}`, series, x, y })] : []), caption);
  }
}

// Asked for at every refresh; drawn anew only where something changed.
export async function showWatched() {
  if (!watched || busy) return;
  busy = true;
  try {
    const id = watched;
    const side = /** @type {Side} */ ($("watch-side").value);
    const [newest, curves] = await Promise.all([ask(`/sessions/${id}/captures?order=newest&limit=1&side=${side}`), ask(`/sessions/${id}/curves`)]);
    const now = `${id} ${side} ${newest[0]?.id} ${curves.looked_at}`;
    if (now === drawn || id !== watched) return;
    if (newest.length) drawFrame(newest[0], await ask(`/sessions/${id}/captures/${newest[0].id}/figures`));
    $("watch-none").hidden = newest.length > 0;
    $("watch-seen").textContent = curves.looked_at < curves.captures ? `${curves.looked_at} of ${curves.captures} captures looked at` : "";
    drawCurves(curves, side);
    drawn = now;
  } finally {
    busy = false;
  }
}

$("watch-side").addEventListener("change", () => showWatched().catch(() => {}));
