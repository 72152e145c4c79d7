// Figures as rows of a table: plain name, camera, value with its uncertainty and unit, the good band, the mark.

import { $, element } from "./page.js";
import { number } from "./charts.js";

/** @param {string} unit */
export const unitText = (unit) => (unit === "1" ? "" : ` ${unit}`);
/** A value to the digit that two digits of its uncertainty reach.
 * @param {number | null | undefined} value
 * @param {number | null} [std] */
export function measured(value, std) {
  if (value == null) return "";
  if (!std) return number(value, 6);
  const decimals = Math.min(20, Math.max(0, 1 - Math.floor(Math.log10(std))));
  return `${value.toFixed(decimals)} ± ${std.toFixed(decimals)}`;
}

/** @param {(number | null)[]} band */
export function bandText([low, high]) {
  const [least, most] = [low, high].map((end) => (end == null ? "" : number(end)));
  if (!least) return `≤ ${most}`;
  return most ? `${least} … ${most}` : `≥ ${least}`;
}

/** @param {string} name */
export const mark = (name) => element("span", { className: `mark ${name}`, textContent: name });

/** @param {Model<"FigureOfFit">} one */
export const figureRow = (one) =>
  element(
    "tr",
    {},
    element("td", { textContent: one.title || one.figure, title: `${one.figure} ${one.place}`.trim() }),
    element("td", { textContent: one.side ?? "the pair" }),
    element("td", { className: "value", textContent: `${measured(one.value, one.std)}${unitText(one.unit)}` }),
    element("td", { textContent: one.good ? bandText(one.good) : "" }),
    element("td", {}, one.mark ? mark(one.mark) : ""),
  );

/** Whether a figure has every word of a search in its names.
 * @param {{title?: string, figure: string, place?: string, side?: string | null, unit: string}} one
 * @param {string} text */
export function isLike(one, text) {
  const names = [one.title, one.figure, one.place, one.side, one.unit].join(" ").toLowerCase();
  return text.toLowerCase().split(/\s+/).every((word) => names.includes(word));
}

const FIRST = 40; // figures that stand there until all are asked for

/** Draws those of `items()` that the search field of the form `id` asks for, now and whenever it is changed: the first
 * of many, until all are asked for.
 * @param {"figures-search" | "calibration-search"} id
 * @param {() => Model<"FigureOfFit">[]} items
 * @param {(found: Model<"FigureOfFit">[]) => void} draw */
export function searchIn(id, items, draw) {
  const all = element("button", { type: "button", hidden: true });
  let whole = false;
  const again = () => {
    const found = items().filter((one) => isLike(one, $(id).elements.search.value));
    all.hidden = whole || found.length <= FIRST;
    all.textContent = `Show all ${found.length}`;
    draw(whole ? found : found.slice(0, FIRST));
  };
  all.addEventListener("click", () => {
    whole = true;
    again();
  });
  $(id).append(all);
  $(id).addEventListener("input", again);
  $(id).addEventListener("submit", (event) => event.preventDefault());
  return again;
}
