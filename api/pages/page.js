// What the modules of the operator's page share: requests, elements, lists that change only where their content does.

/** The element of an id that the page has.
 * @template {keyof Elements} Id
 * @param {Id} id */
export const $ = (id) => /** @type {Elements[Id]} */ (document.getElementById(id));
export const api = "/api/v1";

export const LIVE = ["connecting", "running", "pausing", "paused", "packing"];

export class Problem extends Error {}

/** What an error says.
 * @param {unknown} error */
export const said = (error) => (error instanceof Error ? error.message : String(error));

// What a key allows, as the service decides it: `wanted` is "operate", "calibrate" or "admin"; anything but reading allows a halt.
/** @type {Scope} */
let scope = "read";
/** @param {Scope} mine */
export const scopeIs = (mine) => (scope = mine);
/** @param {Scope} wanted */
export const may = (wanted) => scope === "admin" || scope === wanted;
export const mayHalt = () => scope !== "read";

const ANSWER_MS = 20_000;

/** Asks; every answer, and every one that didn't come, tells whether the service can be reached: the event "connection", with `detail`
 * true or false.
 * @param {string} path
 * @param {RequestInit} options */
export async function reach(path, options = {}, patience = ANSWER_MS) {
  try {
    const response = await fetch(path, { signal: AbortSignal.timeout(patience), ...options });
    document.dispatchEvent(new CustomEvent("connection", { detail: true }));
    return response;
  } catch {
    document.dispatchEvent(new CustomEvent("connection", { detail: false }));
    throw new Problem("the service doesn't answer");
  }
}

/** @type {Get} */
export const ask = async (path) => (await asked(path)).body;

/** A page of a list, and how many items there are on all pages.
 * @template {string} const Path
 * @param {Known<"get", Path>} path
 * @returns {Promise<{items: Answer<"get", Path>, total: number}>} */
export async function page(path) {
  const { body, response } = await asked(path);
  return { items: body, total: Number(response.headers.get("X-Total-Count")) };
}

/**
 * @param {string} path
 * @param {RequestInit} options
 * @returns {Promise<{body: any, response: Response}>} */
async function asked(path, options = {}, patience = ANSWER_MS) {
  /** @type {HeadersInit | undefined} */
  const headers = options.body ? { "Content-Type": "application/json" } : undefined;
  const response = await reach(api + path, { headers, ...options }, patience);
  if (response.status === 401) {
    document.dispatchEvent(new Event("logged-out"));
    throw new Problem("log in first");
  }
  const body = response.status === 204 ? null : await response.json();
  if (!response.ok) throw new Problem(body.detail);
  return { body, response };
}

/**
 * @template {string} Method
 * @param {Method} method
 * @returns {Send<Method>} */
const sends = (method, patience = ANSWER_MS) => async (path, ...body) =>
  (await asked(path, { method: method.toUpperCase(), body: JSON.stringify(body[0]) }, patience)).body;

export const post = sends("post");
export const change = sends("patch");
export const put = sends("put");
/** @type {Delete} */
export const remove = async (path) => (await asked(path, { method: "DELETE" })).body;

/** An element with properties and children.
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Partial<HTMLElementTagNameMap[Tag]>} properties
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[Tag]} */
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** Ids of the items that rows show.
 * @type {WeakMap<Element, unknown>} */
const itemIds = new WeakMap();

/** Gives the keyboard's focus to the control in `place` that is of the kind and the name of the one that had it.
 * @param {Element} place
 * @param {Element} had */
function focusAgain(place, had) {
  const called = (/** @type {Element} */ one) => one.textContent || one.getAttribute("aria-label");
  const same = [...place.querySelectorAll(had.localName)].find((one) => called(one) === called(had));
  if (same instanceof HTMLElement) same.focus({ preventScroll: true });
}

/** Replaces words and links only where something changed; the keyboard's focus stays on the link that it was on.
 * @param {HTMLElement} place
 * @param {...(Node | string)} children without listeners: two that read the same are the same */
export function replace(place, ...children) {
  const made = element("div", {}, ...children);
  if (made.innerHTML === place.innerHTML) return;
  const had = document.activeElement;
  const held = had !== place && place.contains(had);
  place.replaceChildren(...made.childNodes);
  if (held && had) focusAgain(place, had);
}

/** Replaces the rows only where something changed, so that a button doesn't vanish under the pointer. The keyboard's focus stays on
 * what it was on: the same control of the row of the same id.
 * @template Item
 * @param {keyof Elements} place
 * @param {Item[]} items
 * @param {(item: Item) => HTMLElement} row */
export function show(place, items, row) {
  /** @type {HTMLElement} */
  const list = $(place);
  const text = JSON.stringify(items);
  if (list.dataset.shown === text) return;
  list.dataset.shown = text;
  const had = document.activeElement;
  const held = [...list.children].find((one) => one.contains(had));
  const rows = items.map((item) => {
    const made = row(item);
    itemIds.set(made, /** @type {{id?: unknown}} */ (item).id);
    return made;
  });
  list.replaceChildren(...rows);
  const again = held && rows.find((one) => itemIds.get(one) === itemIds.get(held));
  if (again && had) focusAgain(again, had);
}

/** @param {number} seconds */
export function duration(seconds) {
  const s = Math.round(seconds);
  if (s < 90) return `${s} s`;
  return s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`;
}

/** @param {string | null | undefined} text */
export const time = (text) => (text ? text.replace("T", " ").slice(0, 19) : "");

/** A button's or form's action: what goes wrong stands in `place`, an element or the id of one.
 * @template {Event} E
 * @param {keyof Elements | HTMLElement} place
 * @param {(event: E) => unknown} action
 * @returns {(event: E) => Promise<void>} */
export const told = (place, action) => async (event) => {
  event.preventDefault();
  /** @type {HTMLElement} */
  const problem = typeof place === "string" ? $(place) : place;
  problem.textContent = "";
  try {
    await action(event);
  } catch (error) {
    problem.textContent = said(error);
  }
};

/** The options of a select, with what was chosen kept where it is still there.
 * @param {HTMLSelectElement} select
 * @param {string[]} values */
export function options(select, values, text = (/** @type {string} */ value) => value) {
  const kept = select.value;
  if (JSON.stringify(values) === JSON.stringify([...select.options].map((one) => one.value))) return;
  select.replaceChildren(...values.map((value) => element("option", { value, textContent: text(value) })));
  if (values.includes(kept)) select.value = kept;
}

/** A button or a link whose name says what it is for, as `Delete nightly`.
 * @template {"a" | "button"} Tag
 * @param {Tag} tag
 * @param {string} label
 * @param {string} of
 * @param {Partial<HTMLElementTagNameMap[Tag]>} properties
 * @returns {HTMLElementTagNameMap[Tag]} */
export function named(tag, label, of, properties = {}) {
  const made = element(tag, properties, label);
  made.setAttribute("aria-label", `${label} ${of}`);
  return made;
}

/** Cells whose names stand beside them where a narrow window shows rows as blocks.
 * @param {HTMLTableRowElement} row
 * @param {...string} labels */
export function cells(row, ...labels) {
  [...row.cells].forEach((cell, at) => labels[at] && (cell.dataset.label = labels[at]));
  return row;
}

/** The brush of a canvas.
 * @param {HTMLCanvasElement} canvas */
export const brushOf = (canvas) => /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));

// --- views ----------------------------------------------------------------------------------------------------------

/**
 * A view: the section that it shows, its title, and what fills it; `first` where it was gone to just now.
 * @typedef {{pattern: RegExp, section: keyof Elements, title: (...parts: any[]) => string,
 *   show: (first: boolean, ...parts: any[]) => unknown}} View
 */
/** @type {View[]} */
const views = [];
/** @type {{view: View | undefined, parts: string[]}} */
let current = { view: undefined, parts: [] };

/** @param {View} view */
export const addView = (view) => views.push(view);

export const address = () => decodeURI(location.hash.replace(/^#/, "") || "/");
/** @param {string} path */
export const goTo = (path) => (location.hash = `#${encodeURI(path)}`);

// Shows what stands at the page's address, and asks anew what it shows.
export async function showView(first = false) {
  const path = address().replace(/\?.*$/, "");
  const view = views.find((one) => one.pattern.test(path));
  const parts = view?.pattern.exec(path)?.slice(1) ?? [];
  const section = view?.section ?? "view-none";
  if (first) {
    current = { view, parts };
    /** @type {NodeListOf<HTMLElement>} */
    const sections = document.querySelectorAll("section.view");
    for (const one of sections) one.hidden = one.id !== section;
    document.title = `${view?.title(...parts) ?? "No such view"} · calibench`;
    /** @type {NodeListOf<HTMLAnchorElement>} */
    const links = document.querySelectorAll("#nav a");
    for (const link of links) {
      const at = decodeURI(link.hash.slice(1));
      const here = at === "/" ? path === "/" : path.startsWith(at) || (at === "/calibrations" && path.startsWith("/calibration"));
      if (here) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    $("view-problem").textContent = "";
  }
  if (!view) return;
  try {
    await view.show(first, ...parts);
    $("view-problem").textContent = "";
  } catch (error) {
    if (current.view === view) $("view-problem").textContent = said(error);
  }
}

// What the address asks behind its question mark.
export const query = () => new URLSearchParams(address().split("?")[1] ?? "");

// --- long lists -----------------------------------------------------------------------------------------------------

const PAGE = 50;

/** @typedef {"sessions" | "jobs" | "recordings" | "calibrations" | "models" | "predictions"} ListId */

/** A list in pages. Its table's body is `id`; `no-ID`, `more-ID` and `count-ID` stand where there is none, ask for the next page, and say how many.
 * @template {string} Path
 * @template {{id: string}} [Item=Answer<"get", Path> extends (infer One extends {id: string})[] ? One : never]
 * @template [Shown=Item] */
export class Listing {
  /** @type {Item[]} */
  items = [];
  asked = "";
  total = 0;

  /** `shown`: what the rows show of the items.
   * @param {ListId} id @param {Known<"get", Path>} path @param {(one: Shown) => HTMLElement} row @param {(items: Item[]) => Shown[]} shown */
  constructor(id, path, row, shown = (items) => /** @type {any[]} */ (items)) {
    this.id = id;
    this.path = path;
    this.row = row;
    this.shown = shown;
    $(`more-${id}`).addEventListener("click", told("view-problem", () => this.more()));
  }

  #address(after = "") {
    const asked = new URLSearchParams(this.asked);
    asked.set("limit", String(PAGE));
    if (after) asked.set("after", after);
    return `${this.path}?${asked}`;
  }

  /** @returns {Promise<{items: Item[], total: number}>} */
  async #page(after = "") {
    const { body, response } = await asked(this.#address(after));
    return { items: body, total: Number(response.headers.get("X-Total-Count")) };
  }

  // The first page anew; older ones that were asked for stay.
  async refresh(asked = this.asked) {
    if (asked !== this.asked) this.items = [];
    this.asked = asked;
    const { items, total } = await this.#page();
    if (asked !== this.asked) return;
    const last = this.items.findIndex((one) => one.id === items.at(-1)?.id);
    this.items = [...items, ...(items.length < PAGE || last < 0 ? [] : this.items.slice(last + 1))];
    this.total = total;
    this.draw();
  }

  async more() {
    const { items, total } = await this.#page(this.items.at(-1)?.id);
    this.items = [...this.items, ...items];
    this.total = total;
    this.draw();
  }

  draw() {
    show(this.id, this.shown(this.items), this.row);
    $(`no-${this.id}`).hidden = this.items.length > 0;
    $(`more-${this.id}`).hidden = this.items.length >= this.total;
    $(`count-${this.id}`).textContent = this.total > this.items.length ? `${this.items.length} of ${this.total}` : "";
  }
}

/** @param {string} text */
export const clock = (text) => `${time(text).slice(11)} UTC`;

// A halt's answer has to come within this time (ms), or somebody goes to the bench.
const HALT_MS = 2000;

/** A halt that is shown: its station (null: all), the stations that have to answer, when each had answered last before, what each has
 * answered since, and whether the request itself is still to be answered.
 * @typedef {{station: string | null, expected: Set<string>, before: Map<string, string | undefined>, answers: Map<string, Safety>,
 *   pending: boolean}} ShownHalt */
/** @type {Map<HTMLElement, ShownHalt>} */
const halts = new Map();
/** @type {Model<"StationState">[]} */
let latest = [];

/** @param {string} name @param {Safety | undefined} safety @returns {[boolean, string]} whether it is safe, and the text */
function answerOf(name, safety) {
  if (!safety || safety.shutter === "unknown") return [false, `NOT CONFIRMED: go to the bench of ${name} (${safety?.words || (safety ? "its shutter is being asked" : "it hasn't answered")})`];
  const shutter = `${name}: ${safety.shutter === "closed" ? `shutter closed ${clock(safety.at)}` : "no shutter"}`;
  return safety.state === "not confirmed" ? [false, `${shutter}, but NOT CONFIRMED: go to the bench (${safety.words})`] : [true, shutter];
}

/** Shows one answer a station, each with its name. A station that hasn't answered is named, and those that aren't safe come first: no
 * station's answer reads as that of all.
 * @param {HTMLElement} place
 * @param {ShownHalt} halt */
function showHalt(place, { expected, answers }) {
  const texts = [...expected].map((name) => answerOf(name, answers.get(name)));
  const text = [false, true].flatMap((safe) => texts.filter((one) => one[0] === safe).map((one) => one[1])).join("; ");
  place.classList.toggle("unsafe", texts.some(([safe]) => !safe));
  if (place.textContent !== text) place.textContent = text;
}

/** @param {HTMLElement} place */
export const forgetHalt = (place) => {
  halts.delete(place);
  place.textContent = "";
};

/** Shows every halt anew, by what the stations have answered since. A station on which a later session runs is no longer part of it.
 * @param {Model<"StationState">[]} stations */
export function tellHalts(stations) {
  latest = stations;
  for (const [place, halt] of halts) {
    for (const { name, safety, busy_with } of stations) {
      if (!halt.expected.has(name)) continue;
      if (safety && safety.at !== halt.before.get(name)) halt.answers.set(name, safety);
      else if (!halt.pending && !safety && busy_with && halt.answers.delete(name)) halt.expected.delete(name);
    }
    if (!halt.expected.size) forgetHalt(place);
    else if (!halt.pending && halt.answers.size) showHalt(place, halt);
  }
}

const haltNow = sends("post", HALT_MS);

/** Halts a station, or all where none is named. What each station answers stands beside the button, in `place`, once the request is
 * answered: before that, the answer of one station would read as that of all.
 * @param {HTMLElement} place
 * @param {string | null} station */
export async function halt(place, station = null) {
  const names = latest.filter((one) => !station || one.name === station).map((one) => one.name);
  /** @type {ShownHalt} */
  const shown = { station, expected: new Set(names), before: new Map(latest.map((one) => [one.name, one.safety?.at])), answers: new Map(), pending: true };
  place.className = "halted";
  place.textContent = "halting …";
  halts.set(place, shown);
  try {
    const found = await haltNow("/halt", { station });
    if (halts.get(place) !== shown) return;
    for (const { name, safety } of found.stations) {
      shown.expected.add(name);
      shown.answers.set(name, safety);
    }
    if (shown.expected.size) showHalt(place, shown);
    else place.textContent = "halted; there is no station";
  } catch (error) {
    place.classList.add("unsafe");
    place.textContent = `NOT CONFIRMED: go to the bench${names.length ? ` of ${names.join(", ")}` : ""} (${said(error)})`;
  } finally {
    shown.pending = false;
  }
}
