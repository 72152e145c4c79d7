// The drift board: figures by calibrations, coloured by limits and drift; a row's name opens its history.

import { number, svg, ticks } from "./charts.js";
import { isLike, measured, unitText } from "./figures.js";
import { $, addView, ask, element, options, query, show, time, told } from "./page.js";

const HEIGHT = 256;
const LEFT = 76;
const RIGHT = 14;
const TOP = 12;
const BOTTOM = 50;
const form = $("drift-form").elements;

/** @type {Model<"DriftBoard">} */
let board;
let asked = ""; // camera and reference temperature of the board
let figure = ""; // key of the row whose history stands there
let unfolded = false; // whether the many figures of the edges' MTFs stand there

/** @typedef {Model<"BoardRow">} Row */
/** @typedef {Model<"HistoryPoint">} Point */

/** @param {Row} one */
const keyOf = (one) => JSON.stringify([one.figure, one.place]);
/** @param {{title?: string, figure: string, place?: string}} one */
const titleOf = (one) => one.title || [one.figure, one.place].filter(Boolean).join(" ");
/** @param {number | null | undefined} temperature_c */
const degrees = (temperature_c) => (temperature_c == null ? "" : `${number(temperature_c, 3)} °C`);
/** @param {string} name */
const cameraName = (name) => (name.startsWith("{") ? "the pair" : name);
/** @param {Row} row */
const needsLook = (row) => row.cells.some((cell) => cell && (cell.drifted || ["warn", "bad"].includes(cell.mark ?? "")));

// --- the board ------------------------------------------------------------------------------------------------------

/** @param {Model<"BoardCell"> | null} one @param {Model<"BoardColumn">} column @param {Row} row */
function cell(one, column, row) {
  if (!one) return element("td", { className: "cell none", textContent: "–" });
  const state = [one.mark ?? "", one.drifted ? "drifted" : ""].join(" ");
  const made = element("td", { className: `cell ${state}`, textContent: `${one.drifted ? "◆ " : ""}${number(one.value, 4)}` });
  const words = [one.mark, one.drifted ? `drifted, ${number(one.significance_sigma ?? NaN, 3)} σ` : "", one.corrected ? `at ${degrees(row.reference_c)}` : ""];
  made.title = `${column.name}, ${time(column.created)}: ${measured(one.value, one.std)}${unitText(row.unit)}${words.filter(Boolean).map((word) => `, ${word}`).join("")}`;
  return made;
}

/** @param {Row} row */
function rowOf(row) {
  const link = element("button", { className: "quiet", textContent: titleOf(row), title: `${row.figure} ${row.place}`.trim() });
  link.addEventListener("click", told("drift-problem", () => openHistory(row)));
  const name = element("th", { scope: "row" }, link);
  name.append(element("span", { className: "hint", textContent: `${row.unit === "1" ? "" : ` ${row.unit}`}${row.reference_c == null ? "" : ` at ${degrees(row.reference_c)}`}` }));
  return element("tr", {}, name, ...row.cells.map((one, at) => cell(one, board.columns[at], row)));
}

/** Days, and of those on which there are several, the times.
 * @param {{created: string}[]} of */
function shortTimes(of) {
  const days = of.map((one) => one.created.slice(0, 10));
  return of.map(({ created }, at) => (days.indexOf(days[at]) === days.lastIndexOf(days[at]) ? days[at] : `${days[at].slice(5)} ${created.slice(11, 16)}`));
}

/** The line that folds the figures of the edges' MTFs, or shows them.
 * @param {Row[]} rows */
function foldOf(rows) {
  const look = rows.filter(needsLook).length;
  const text = `MTF by edge and channel: ${rows.length} figures, ${look || "none"} out of limits or drifted`;
  const button = element("button", { className: "quiet", textContent: text });
  button.setAttribute("aria-expanded", String(unfolded));
  button.addEventListener("click", () => {
    unfolded = !unfolded;
    draw();
  });
  return element("tr", { className: "fold" }, element("th", { scope: "row" }, button), element("td", { colSpan: board.columns.length }));
}

function draw() {
  const found = board.rows.filter((row) => isLike(row, form.search.value) && (!form.attention.checked || needsLook(row)));
  // Where somebody looks for some figures, all that are found stand there.
  const folds = !form.search.value.trim() && !form.attention.checked;
  const many = folds ? found.filter((row) => row.group === "mtf") : [];
  const times = shortTimes(board.columns);
  const head = board.columns.map((one, at) => {
    const link = element("a", { href: `#/calibrations/${one.calibration_id}`, textContent: times[at], title: `${one.name}, ${time(one.created)}, ${one.state}` });
    link.setAttribute("aria-label", `${one.name}, ${time(one.created)}, ${one.state}`);
    const column = element("th", { scope: "col", className: one.state }, link);
    if (one.state === "certified") column.append(" ✓");
    return column;
  });
  $("drift-head").replaceChildren(element("tr", {}, element("th", { scope: "col", textContent: "Figure" }), ...head));
  delete $("drift-rows").dataset.shown;
  /** @type {({id: string, row: Row} | {id: string, fold: boolean})[]} */
  const rows = found.filter((row) => !many.includes(row)).map((row) => ({ id: keyOf(row), row }));
  if (many.length) rows.push({ id: "fold", fold: unfolded }, ...(unfolded ? many.map((row) => ({ id: keyOf(row), row })) : []));
  show("drift-rows", rows, (one) => ("row" in one ? rowOf(one.row) : foldOf(many)));
  const look = board.rows.filter(needsLook).length;
  const law = board.rows.find((row) => row.law);
  const words = [`${found.length} of ${board.rows.length} figures, ${board.columns.length} calibrations, the oldest first, times in UTC`, `${look || "none"} out of limits or drifted`];
  if (law) words.push(`dark currents at ${degrees(law.reference_c)}: ${law.law}`);
  $("drift-told").textContent = words.join("; ");
}

/** @param {boolean} anew */
async function showBoard(anew) {
  const camera = form.camera.value;
  const wanted = new URLSearchParams({ camera });
  if (form.reference_c.value !== "") wanted.set("reference_c", form.reference_c.value);
  if (!anew && asked === wanted.toString()) return;
  const found = await ask(`/drift?${wanted}`);
  if (camera !== form.camera.value) return;
  board = found;
  asked = wanted.toString();
  draw();
}

// --- a figure's history ---------------------------------------------------------------------------------------------

/** @param {Row} row */
async function openHistory(row) {
  figure = keyOf(row);
  const parts = { camera: form.camera.value, figure: row.figure, place: row.place };
  const history = await ask(`/history?${new URLSearchParams(parts)}`);
  $("history-part").hidden = false; // it is as wide as the view then
  drawHistory(history);
  $("history-title").focus();
  $("history-part").scrollIntoView({ block: "nearest" });
}

/** @param {number} from @param {number} to */
const rangeOf = (from, to) => (to > from ? [from, to] : [from - 1, to + 1]);

/** @param {Model<"History">} history */
function drawHistory(history) {
  const width = Math.min(Math.max($("history").clientWidth || 720, 320), 720); // a phone's letters are as large as a desktop's
  const points = history.points;
  const ends = points.flatMap((p) => [p.value - 2 * p.std, p.value + 2 * p.std]);
  const bands = history.limit ? [history.limit.good, history.limit.warn ?? history.limit.good] : [];
  const [least, most] = rangeOf(Math.min(...ends), Math.max(...ends));
  const spread = most - least;
  // The ends of the bands are shown where that leaves the points half of the height.
  const near = bands.flat().filter((end) => end !== null).filter((end) => end > least - spread && end < most + spread);
  const [bottom, top] = rangeOf(Math.min(least, ...near) - 0.08 * spread, Math.max(most, ...near) + 0.08 * spread);
  const x = (/** @type {number} */ at) => LEFT + ((width - LEFT - RIGHT) * (at + 0.5)) / points.length;
  const y = (/** @type {number} */ value) => TOP + ((HEIGHT - TOP - BOTTOM) * (top - Math.min(Math.max(value, bottom), top))) / (top - bottom);
  /** @param {(number | null)[]} ends @param {string} name */
  const band = ([low, high], name) =>
    svg("rect", { class: `band ${name}`, x: LEFT, width: width - LEFT - RIGHT, y: y(high ?? top), height: y(low ?? bottom) - y(high ?? top) });
  const newest = points[points.length - 1];
  const drifted = points.filter((p) => p.drifted).length;
  const title = titleOf(history);
  const valueText = (/** @type {Point} */ p) => `${measured(p.value, p.std)}${unitText(history.unit)}${p.temperature_c == null ? "" : ` at ${degrees(p.temperature_c)}`}`;
  const summary = `${title} of ${cameraName(history.camera)}: ${points.length} calibrations, the newest, of ${time(newest.created).slice(0, 16)} UTC, ${valueText(newest)}${newest.mark ? `, ${newest.mark}` : ""}, ${drifted || "none"} drifted`;
  const picture = svg("svg", { viewBox: `0 0 ${width} ${HEIGHT}`, role: "img", "aria-label": summary });
  if (bands.length) picture.append(band(bands[1], "warn"), band(bands[0], "good"));
  for (const value of ticks(bottom, top)) {
    picture.append(svg("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }));
    picture.append(svg("text", { x: LEFT - 8, y: y(value) + 4, "text-anchor": "end" }, number(value)));
  }
  const every = Math.ceil(points.length / Math.max(2, Math.floor((width - LEFT - RIGHT) / 84)));
  const times = shortTimes(points);
  picture.append(svg("text", { x: (LEFT + width - RIGHT) / 2, y: HEIGHT - 6, "text-anchor": "middle" }, "fitted (UTC)"));
  points.forEach((p, at) => {
    const mark = svg("g", { class: `point ${p.mark ?? ""} ${p.state}` }, svg("title", {}, `${time(p.created)}: ${valueText(p)}`));
    mark.append(svg("line", { x1: x(at), x2: x(at), y1: y(p.value - 2 * p.std), y2: y(p.value + 2 * p.std) }));
    // A drift has another shape, not only another colour.
    const [cx, cy] = [x(at), y(p.value)];
    mark.append(p.drifted ? svg("path", { d: `M${cx - 7} ${cy}L${cx} ${cy - 7}L${cx + 7} ${cy}L${cx} ${cy + 7}Z` }) : svg("circle", { cx, cy, r: 4.5 }));
    if (p.state === "certified") mark.append(svg("circle", { class: "ring", cx, cy, r: 9 }));
    picture.append(mark);
    if (at % every === 0) picture.append(svg("text", { x: cx, y: HEIGHT - 26, "text-anchor": "middle" }, times[at]));
  });
  $("history-title").textContent = `History of ${title}`;
  $("history").replaceChildren(picture);
  $("history-words").textContent = summary;
  $("history-rows").replaceChildren(
    ...points.toReversed().map((p) =>
      element(
        "tr",
        {},
        element("td", { textContent: time(p.created) }),
        element("td", {}, element("a", { href: `#/calibrations/${p.calibration_id}`, textContent: p.state })),
        element("td", { textContent: valueText(p) }),
        element("td", { textContent: p.mark ?? "" }),
        element("td", { textContent: p.drifted ? `drifted, ${number(p.significance_sigma ?? NaN, 3)} sigma` : "" }),
      ),
    ),
  );
}

// --- the view -------------------------------------------------------------------------------------------------------

for (const name of /** @type {const} */ (["search", "attention"])) form[name].addEventListener("input", () => asked && draw());
for (const name of /** @type {const} */ (["camera", "reference_c"])) {
  form[name].addEventListener("change", told("drift-problem", async () => {
    $("history-part").hidden = true;
    figure = "";
    await showBoard(true);
  }));
}
$("drift-form").addEventListener("submit", (event) => event.preventDefault());

addView({
  pattern: /^\/drift$/,
  section: "view-drift",
  title: () => "Drift",
  async show(first) {
    if (!first) return; // a board changes with a fit, not by itself
    const named = [...new Set((await ask("/figures")).map((one) => one.camera))];
    options(form.camera, named, cameraName);
    const wanted = query().get("camera");
    if (wanted !== null) form.camera.value = wanted;
    const none = named.length === 0;
    $("no-drift").hidden = !none;
    for (const id of /** @type {const} */ (["drift-form", "drift-scroll"])) $(id).hidden = none;
    if (!none) await showBoard(true);
    if (figure) $("history-part").hidden = false;
  },
});
