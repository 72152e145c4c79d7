// One frame, raw: zoom, readout in DN, a line's profile, the difference of two frames, saturated pixels.

import { chart, number } from "./charts.js";
import { $, addView, api, ask, brushOf, element, options, reach, told } from "./page.js";
import { exposure } from "./frames.js";
import { drawChannels } from "./watch.js";

/** @typedef {{row: number, col: number}} Spot */
/** @typedef {{rows: number, cols: number, codes: Uint16Array}} Raw */
const NPY = { magic: 10, length: 8 }; // where the header of a .npy of version 1 begins, and where its length stands
const SATURATED = [214, 39, 130];
const CLICK_PX = 4; // a pointer that moves less hasn't dragged

/** The raw frame of a .npy: uint16, rows by columns.
 * @param {string} path
 * @returns {Promise<Raw>} */
async function rawOf(path) {
  const content = await (await reach(path, {}, 120_000)).arrayBuffer();
  const header = new DataView(content).getUint16(NPY.length, true);
  const text = new TextDecoder().decode(content.slice(NPY.magic, NPY.magic + header));
  const [rows, cols] = (/'shape': \((\d+), (\d+)\)/.exec(text) ?? []).slice(1).map(Number);
  if (!cols) throw new Error("the frame that came isn't one of rows and columns");
  return { rows, cols, codes: new Uint16Array(content, NPY.magic + header, rows * cols) };
}

/** @type {Source} */
let source;
/** @type {Model<"StoredCapture"> | Model<"RecordedCapture">} */
let capture; // the one that stands there
/** @type {Model<"FrameFigures">} */
let figures;
/** @type {Raw} */
let raw;
let here = false; // whether `raw` is of the frame that stands there
/** @type {Raw | null} */
let other = null;
/** @type {Int32Array | Uint16Array} */
let values = new Uint16Array(); // what is drawn: the codes, or their difference
let shown = "";
let view = { scale: 1, left: 0, top: 0 }; // canvas px a pixel; the frame's place in the corner
let cross = { row: 0, col: 0 };
/** @type {Spot | null} */
let marked = null;

const canvas = $("inspect-canvas");
const form = $("inspect-form").elements;
/** The channel of a pixel of the mosaic.
 * @param {number} row @param {number} col */
const channelAt = (row, col) => figures.channels.find((one) => (row - one.row) % step() === 0 && (col - one.col) % step() === 0) ?? figures.channels[0];
/** The channel whose pixels alone are drawn: the one that is chosen; of a reduced mosaic, whose neighbours would be mixed, the first.
 * @returns {Model<"ChannelFigures"> | null} */
const drawnChannel = () => {
  const chosen = figures.channels.find((one) => one.channel === form.channel.value);
  return chosen ?? (view.scale < 1 && step() > 1 ? channelAt(0, 0) : null);
};
// Of a mosaic, a profile takes the pixels of one channel.
const step = () => (figures.channels.length > 1 ? 2 : 1);
/** @param {number} row @param {number} col */
const at = (row, col) => values[row * raw.cols + col];
/** @param {number} value @param {number} most */
const clamp = (value, most) => Math.min(Math.max(Math.round(value), 0), most - 1);

function auto() {
  /** @type {number[]} */
  const some = [];
  const every = Math.max(1, Math.floor(values.length / 50_000));
  for (let n = 0; n < values.length; n += every) some.push(values[n]);
  some.sort((a, b) => a - b);
  const part = (/** @type {number} */ share) => some[Math.min(some.length - 1, Math.floor(share * some.length))];
  const [low, high] = other ? [-1, 1].map((sign) => sign * Math.max(1, Math.abs(part(0.001)), Math.abs(part(0.999)))) : [part(0.001), part(0.999)];
  form.low.value = String(low);
  form.high.value = String(Math.max(high, low + 1));
}

function fit() {
  const scale = Math.min(canvas.width / raw.cols, canvas.height / raw.rows);
  view = { scale, left: (raw.cols - canvas.width / scale) / 2, top: (raw.rows - canvas.height / scale) / 2 };
  draw();
}

/** Zooms about a place of the canvas, by default about the cross.
 * @param {number} factor */
function zoom(factor, x = (cross.col + 0.5 - view.left) * view.scale, y = (cross.row + 0.5 - view.top) * view.scale) {
  const scale = Math.min(Math.max(view.scale * factor, 0.02), 64);
  view = { scale, left: view.left + x / view.scale - x / scale, top: view.top + y / view.scale - y / scale };
  draw();
}

/** @param {number} value @param {number} low @param {number} high */
function colourOf(value, low, high) {
  const part = Math.min(Math.max((value - low) / (high - low), 0), 1);
  if (!other) return [255 * part, 255 * part, 255 * part];
  const signed = 2 * part - 1; // red: brighter than the other frame, blue: darker
  const [fades, stays] = [255 - 215 * Math.abs(signed), 255 - 90 * Math.abs(signed)];
  return signed > 0 ? [stays, fades, fades] : [fades, fades, stays];
}

function draw() {
  const [low, high] = [Number(form.low.value), Number(form.high.value)];
  const brush = brushOf(canvas);
  const picture = brush.createImageData(canvas.width, canvas.height);
  const saturation = Math.ceil(figures.saturation_dn);
  const channel = drawnChannel();
  /** The pixel of the drawn channel in the mosaic's period of a pixel.
   * @param {number} at @param {number} first */
  const nearest = (at, first) => (channel ? Math.floor(at / step()) * step() + first : at);
  for (let y = 0, n = 0; y < canvas.height; y++) {
    const row = nearest(Math.floor(view.top + y / view.scale), channel?.row ?? 0);
    for (let x = 0; x < canvas.width; x++, n += 4) {
      const col = nearest(Math.floor(view.left + x / view.scale), channel?.col ?? 0);
      if (row < 0 || col < 0 || row >= raw.rows || col >= raw.cols) continue;
      const full = !other && raw.codes[row * raw.cols + col] >= saturation;
      const [red, green, blue] = full ? SATURATED : colourOf(at(row, col), low, high);
      picture.data.set([red, green, blue, 255], n);
    }
  }
  brush.putImageData(picture, 0, 0);
  brush.strokeStyle = "#e0a400";
  brush.lineWidth = 1;
  const place = (/** @type {Spot} */ spot) => [(spot.col + 0.5 - view.left) * view.scale, (spot.row + 0.5 - view.top) * view.scale];
  const [x, y] = place(cross);
  brush.beginPath();
  for (const [right, down] of [[-1, 0], [1, 0], [0, -1], [0, 1]]) {
    brush.moveTo(x + 4 * right, y + 4 * down);
    brush.lineTo(x + 14 * right, y + 14 * down);
  }
  if (marked && form.along.value === "line") {
    const [fromX, fromY] = place(marked);
    brush.moveTo(fromX, fromY);
    brush.lineTo(x, y);
  }
  brush.stroke();
  canvas.setAttribute("aria-label", `${capture.name}, ${capture.side} camera, ${raw.cols} by ${raw.rows} pixels; ${readout()}`);
  $("inspect-readout").textContent = readout();
  drawProfile();
}

function readout() {
  const where = `column ${cross.col}, row ${cross.row}${step() > 1 ? `, ${channelAt(cross.row, cross.col).channel}` : ""}`;
  const channel = drawnChannel();
  const picture = [view.scale >= 1 ? "" : `shown at ${number(view.scale, 2)}`, channel && step() > 1 ? `picture of channel ${channel.channel}` : ""];
  const shownAs = picture.filter(Boolean).map((words) => `, ${words}`).join("");
  const code = raw.codes[cross.row * raw.cols + cross.col];
  if (other) return `${where}: ${code} DN less ${code - at(cross.row, cross.col)} DN is ${at(cross.row, cross.col)} DN${shownAs}`;
  return `${where}: ${code} DN${code >= figures.saturation_dn ? ", saturated" : ""}${shownAs}`;
}

// The values along the row, the column, or the line from the mark to the cross.
function profile() {
  const points = [];
  if (form.along.value === "row") for (let col = cross.col % step(); col < raw.cols; col += step()) points.push([col, at(cross.row, col)]);
  else if (form.along.value === "column") for (let row = cross.row % step(); row < raw.rows; row += step()) points.push([row, at(row, cross.col)]);
  else {
    const from = marked ?? { row: 0, col: 0 };
    const [down, right] = [cross.row - from.row, cross.col - from.col];
    const long = Math.max(Math.abs(down), Math.abs(right), 1);
    /** @param {number} value @param {number} like */
    const same = (value, like) => value - (((value - like) % step()) + step()) % step();
    for (let n = 0; n <= long; n += step()) {
      const [row, col] = [same(Math.round(from.row + (down * n) / long), from.row), same(Math.round(from.col + (right * n) / long), from.col)];
      points.push([(n / long) * Math.hypot(down, right), at(clamp(row, raw.rows), clamp(col, raw.cols))]);
    }
  }
  return points;
}

// A line begins at the mark.
const profiled = () => (form.along.value === "line" ? channelAt(marked?.row ?? 0, marked?.col ?? 0) : channelAt(cross.row, cross.col));

function drawProfile() {
  const along = /** @type {"row" | "column" | "line"} */ (form.along.value);
  const points = profile();
  const every = Math.ceil(points.length / 1200);
  const name = { row: `row ${cross.row}`, column: `column ${cross.col}`, line: "the line" }[along];
  const series = [{ name, colour: 2, line: true, points: points.filter((_, n) => n % every === 0) }];
  const most = points.reduce((so, [, value]) => Math.max(so, value), -Infinity);
  const title = `Profile along ${name}: ${points.length} pixels, at most ${most} DN`;
  const label = { row: "column", column: "row", line: "distance, px" }[along];
  const caption = element("figcaption", { textContent: `${title}${step() > 1 ? `, of channel ${profiled().channel}` : ""}${along === "line" && !marked ? "; mark where it begins" : ""}` });
  $("inspect-profile").replaceChildren(chart({ title, series, x: { label }, y: { label: other ? "difference, DN" : "DN" } }), caption);
}

// --- pointer and keys -----------------------------------------------------------------------------------------------

/** @param {number} row @param {number} col */
function crossAt(row, col) {
  cross = { row: clamp(row, raw.rows), col: clamp(col, raw.cols) };
  const [x, y] = [(cross.col + 0.5 - view.left) * view.scale, (cross.row + 0.5 - view.top) * view.scale];
  if (x < 0) view.left = cross.col - 2;
  if (y < 0) view.top = cross.row - 2;
  if (x > canvas.width) view.left = cross.col + 3 - canvas.width / view.scale;
  if (y > canvas.height) view.top = cross.row + 3 - canvas.height / view.scale;
  draw();
}

const mark = () => {
  marked = { ...cross };
  form.along.value = "line";
  draw();
};

/** @type {Record<string, (far: number) => void>} */
const KEYS = {
  ArrowLeft: (far) => crossAt(cross.row, cross.col - far),
  ArrowRight: (far) => crossAt(cross.row, cross.col + far),
  ArrowUp: (far) => crossAt(cross.row - far, cross.col),
  ArrowDown: (far) => crossAt(cross.row + far, cross.col),
  "+": () => zoom(2),
  "=": () => zoom(2),
  "-": () => zoom(0.5),
  0: fit,
  m: mark,
  M: mark,
};

canvas.addEventListener("keydown", (event) => {
  const does = KEYS[event.key];
  if (!does || !here || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  does(event.shiftKey ? 10 : 1);
});
canvas.addEventListener("wheel", (event) => {
  if (!here) return;
  event.preventDefault();
  const { x, y } = inCanvas(event);
  zoom(event.deltaY < 0 ? 1.25 : 0.8, x, y);
}, { passive: false });

/** @param {MouseEvent} event */
const inCanvas = (event) => {
  const box = canvas.getBoundingClientRect();
  return { x: ((event.clientX - box.left) * canvas.width) / box.width, y: ((event.clientY - box.top) * canvas.height) / box.height };
};
/** The pointer that is held down: where it was, and where the frame was then.
 * @type {{x: number, y: number, left: number, top: number, moved: boolean} | null} */
let held = null;
canvas.addEventListener("pointerdown", (event) => {
  if (!here) return;
  canvas.setPointerCapture(event.pointerId);
  held = { ...inCanvas(event), left: view.left, top: view.top, moved: false };
});
canvas.addEventListener("pointermove", (event) => {
  if (!held) return;
  const { x, y } = inCanvas(event);
  held.moved ||= Math.hypot(x - held.x, y - held.y) > CLICK_PX;
  if (!held.moved) return;
  view = { ...view, left: held.left - (x - held.x) / view.scale, top: held.top - (y - held.y) / view.scale };
  draw();
});
canvas.addEventListener("pointerup", () => {
  if (held && !held.moved) crossAt(Math.floor(view.top + held.y / view.scale), Math.floor(view.left + held.x / view.scale));
  held = null;
});
$("inspect-in").addEventListener("click", () => zoom(2));
$("inspect-out").addEventListener("click", () => zoom(0.5));
$("inspect-fit").addEventListener("click", () => fit());
$("inspect-mark").addEventListener("click", mark);
$("inspect-auto").addEventListener("click", () => (auto(), draw()));
$("inspect-form").addEventListener("submit", (event) => event.preventDefault());
for (const field of [form.low, form.high, form.along, form.channel]) field.addEventListener("change", () => here && draw());
form.minus.addEventListener("change", told("view-problem", async () => {
  await less(form.minus.value);
  auto();
  draw();
}));

/** Frames that may be taken away from the one that stands there: their names by id.
 * @type {Map<string, string>} */
let names = new Map();

// Those frames of which the search knows every word, and the one that is chosen.
function showOthers() {
  const words = form.find.value.toLowerCase().split(/\s+/);
  const found = [...names].filter(([id, name]) => id === form.minus.value || words.every((word) => name.toLowerCase().includes(word)));
  options(form.minus, ["", ...found.map(([id]) => id)], (value) => names.get(value) ?? "none");
}
form.find.addEventListener("input", showOthers);

/** Takes another frame away from this one; "" none.
 * @param {string} id */
async function less(id) {
  other = null;
  values = raw.codes;
  if (!id) return;
  const found = await rawOf(`${api}/${source.kind}/${source.id}/captures/${id}/frame.npy`);
  if (found.rows !== raw.rows || found.cols !== raw.cols) throw new Error("the frames have different sizes");
  other = found;
  values = Int32Array.from(raw.codes, (code, n) => code - found.codes[n]);
}

// --- the view -------------------------------------------------------------------------------------------------------

/** @param {boolean} first @param {Source["kind"]} kind @param {string} id @param {string} number_ */
async function showFrame(first, kind, id, number_) {
  if (!first && shown === `${kind}/${id}/${number_}`) return; // a frame never changes
  shown = "";
  here = false;
  marked = null;
  source = { kind, id };
  const path = /** @type {const} */ (`/${kind}/${id}/captures/${number_}`);
  $("inspect-title").textContent = "A frame";
  $("inspect-readout").textContent = "The frame is being fetched.";
  $("inspect-back").href = `#/${kind}/${id}/frames`;
  $("inspect-npy").href = `${api}${path}/frame.npy`;
  [capture, figures] = await Promise.all([ask(path), ask(`${path}/figures`)]);
  const others = await ask(`/${kind}/${id}/captures?limit=400&order=newest&side=${capture.side}`);
  const found = await rawOf(`${api}${path}/frame.npy`);
  $("inspect-title").textContent = `${capture.name}, ${capture.side} camera${exposure(capture.exposure_s)}`;
  raw = found;
  here = true;
  const frames = new Map(others.filter((one) => one.document.frame !== capture.document.frame).map((one) => [one.document.frame, one]));
  names = new Map([...frames.values()].map((one) => [String(one.id), `${one.name}${exposure(one.exposure_s)}`]));
  form.find.value = form.minus.value = "";
  showOthers();
  options(form.channel, ["", ...(step() > 1 ? figures.channels.map((one) => one.channel) : [])], (value) => value || (step() > 1 ? "all" : figures.channels[0].channel));
  form.channel.value = "";
  await less("");
  drawChannels("inspect-figures", figures);
  canvas.width = Math.max(280, canvas.clientWidth);
  canvas.height = Math.round(Math.min(canvas.width * (raw.rows / raw.cols), 640));
  cross = { row: raw.rows >> 1, col: raw.cols >> 1 };
  auto();
  fit();
  shown = `${kind}/${id}/${number_}`;
}

addView({
  pattern: /^\/(sessions|recordings)\/([0-9A-Za-z-]+)\/frames\/(\d+)$/,
  section: "view-frame",
  title: (_kind, id, number_) => `Frame ${number_} of ${id}`,
  show: showFrame,
});
