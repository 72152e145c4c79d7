// Charts as SVG, drawn by the page itself: axes, points with a shape of their own for each series, lines.

import { $ } from "./page.js";

const SVG = $("svg").content.firstElementChild?.namespaceURI ?? "";
const WIDTH = 360;
const HEIGHT = 230;
const LEFT = 52;
const RIGHT = 10;
const TOP = 10;
const BOTTOM = 40;

/** A number in so many digits.
 * @param {number} value */
export const number = (value, digits = 5) => Number(value.toPrecision(digits)).toString();

/** An element of SVG with attributes and children.
 * @param {string} tag
 * @param {Record<string, string | number>} attributes
 * @param {...(Node | string)} children */
export function svg(tag, attributes, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, String(value));
  made.append(...children);
  return made;
}

/** Round values between two ends, four or so.
 * @param {number} low
 * @param {number} high */
export function ticks(low, high) {
  const rough = (high - low) / 5;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 2.5, 5].find((factor) => factor * power >= rough) ?? 10);
  const found = [];
  for (let at = Math.ceil(low / step); at * step <= high; at++) found.push(Number((at * step).toPrecision(12)));
  return found;
}

/** Powers of ten, and 2 and 5 times them where the range is short.
 * @param {number} low
 * @param {number} high */
const decades = (low, high) => {
  const steps = high / low > 300 ? [1] : [1, 2, 5];
  const found = [];
  for (let at = Math.floor(Math.log10(low)); 10 ** at <= high; at++) found.push(...steps.map((step) => step * 10 ** at));
  return found.filter((value) => value >= low * 0.9999 && value <= high * 1.0001);
};
const short = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits: 3 });
/** @param {number} value */
const label = (value) => (Math.abs(value) >= 10_000 ? short.format(value) : number(value, 3));

/** @type {((x: number, y: number) => Element)[]} */
const SHAPES = [
  (x, y) => svg("circle", { cx: x, cy: y, r: 3 }),
  (x, y) => svg("rect", { x: x - 2.8, y: y - 2.8, width: 5.6, height: 5.6 }),
  (x, y) => svg("path", { d: `M${x} ${y - 3.8}L${x + 3.6} ${y + 2.8}L${x - 3.6} ${y + 2.8}Z` }),
  (x, y) => svg("path", { d: `M${x - 3.8} ${y}L${x} ${y - 3.8}L${x + 3.8} ${y}L${x} ${y + 3.8}Z` }),
];

/** Points [x, y] of one colour: marks of a shape of their own, or a line.
 * @typedef {{name: string, colour: number, points: number[][], line?: boolean, dashed?: boolean}} Series */
/** @typedef {{label: string, log?: boolean, from?: number, to?: number}} Axis */

/** Where values of an axis stand between two places of the picture.
 * @param {number[]} values
 * @param {Axis} axis
 * @param {number} first
 * @param {number} last */
function scale(values, { log = false, from, to }, first, last) {
  const usable = log ? values.filter((v) => v > 0) : values;
  let low = from ?? Math.min(...usable);
  let high = to ?? Math.max(...usable);
  if (!(high > low)) [low, high] = log ? [low / 2, low * 2] : [low - 1, low + 1];
  const into = log ? Math.log10 : (/** @type {number} */ v) => v;
  const place = (/** @type {number} */ v) => first + ((last - first) * (into(v) - into(low))) / (into(high) - into(low));
  return { place, ticks: log ? decades(low, high) : ticks(low, high), takes: (/** @type {number} */ v) => Number.isFinite(v) && (!log || v > 0) };
}

/** A chart; `title` says in words what is seen.
 * @param {{title: string, series: Series[], x: Axis, y: Axis}} of */
export function chart({ title, series, x, y }) {
  const picture = svg("svg", { class: "chart", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": title });
  const every = series.flatMap((one) => one.points);
  if (!every.length) return picture;
  const across = scale(every.map((p) => p[0]), x, LEFT, WIDTH - RIGHT);
  const up = scale(every.map((p) => p[1]), y, HEIGHT - BOTTOM, TOP);
  for (const value of up.ticks) {
    const at = up.place(value);
    picture.append(svg("line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: at, y2: at }));
    picture.append(svg("text", { x: LEFT - 6, y: at + 4, "text-anchor": "end" }, label(value)));
  }
  for (const value of across.ticks) {
    const at = across.place(value);
    picture.append(svg("line", { class: "grid", x1: at, x2: at, y1: TOP, y2: HEIGHT - BOTTOM }));
    picture.append(svg("text", { x: at, y: HEIGHT - BOTTOM + 15, "text-anchor": "middle" }, label(value)));
  }
  picture.append(svg("text", { x: (LEFT + WIDTH - RIGHT) / 2, y: HEIGHT - 6, "text-anchor": "middle" }, x.label));
  picture.append(svg("text", { x: -(TOP + HEIGHT - BOTTOM) / 2, y: 12, "text-anchor": "middle", transform: "rotate(-90)" }, y.label));
  for (const one of series) {
    const drawn = svg("g", { class: `series c${one.colour}` });
    const points = one.points.filter(([a, b]) => across.takes(a) && up.takes(b)).map(([a, b]) => [across.place(a), up.place(b)]);
    if (one.line && points.length) drawn.append(svg("path", { class: one.dashed ? "line dashed" : "line", d: `M${points.map((p) => p.map((v) => v.toFixed(1)).join(" ")).join("L")}` }));
    else drawn.append(...points.map(([a, b]) => SHAPES[one.colour % SHAPES.length](a, b)));
    picture.append(drawn);
  }
  return picture;
}

/** The key of a chart: a name beside a mark of its colour and shape.
 * @param {Omit<Series, "points">[]} names */
export const key = (names) =>
  names.map(({ name, colour, line, dashed }) => {
    const entry = document.createElement("span");
    entry.className = "key";
    const mark = svg("svg", { viewBox: "0 0 10 10", "aria-hidden": "true" });
    const inside = svg("g", { class: `series c${colour}` });
    inside.append(line ? svg("path", { class: dashed ? "line dashed" : "line", d: "M0 5L10 5" }) : SHAPES[colour % SHAPES.length](5, 5));
    mark.append(inside);
    entry.append(mark, name);
    return entry;
  });
