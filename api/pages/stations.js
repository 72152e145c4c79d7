// Stations at a glance: on every view a line each with shutter, light, screen and the age of that; at the desk a card each, with what runs
// there and a halt; and a view each, with its instruments' health.

import { asksBanner } from "./asks.js";
import { $, LIVE, addView, api, ask, cells, clock, duration, element, forgetHalt, halt, may, mayHalt, named, post, replace, show, tellHalts, time, told } from "./page.js";

// A browser keeps six connections to a service open; the streams leave some of them for requests.
const STREAMS = 3;
/** @typedef {Model<"SessionDetail"> | Model<"ListedSession">} Session */
/** What stands on a card, what it shows, and the station's line on every view.
 * @typedef {ReturnType<typeof card>} Parts */
/** Parts by their card's key: a station's name, or the id of a session elsewhere.
 * @type {Map<string, Parts>} */
const cards = new Map();
/** Event streams by their sessions.
 * @type {Map<string, EventSource>} */
const streams = new Map();
/** What was last told of each session that runs.
 * @type {Map<string, Session>} */
const known = new Map();
/** @type {() => void} */
let follower = () => {};
let connected = true;

/** @param {() => void} ended */
export function stationsAre(ended) {
  follower = ended;
}

export function leaveStations() {
  for (const parts of cards.values()) forget(parts);
  cards.clear(); // another key may do other things
  for (const stream of streams.values()) stream.close();
  streams.clear();
}

/** @param {number | null | undefined} seconds */
const left = (seconds) => (seconds == null ? "" : `${duration(seconds)} left`);

/** A station's card; of a session elsewhere where there is no name.
 * @param {string | null} name @param {string} title */
function card(name, title) {
  const parts = {
    title: element("h3"),
    state: element("span", { className: "state" }),
    shutter: element("dd"),
    light: element("dd"),
    temperature: element("dd"),
    name: element("strong"),
    bar: element("progress", { max: 1, value: 0 }),
    step: element("p", { className: "step" }),
    remarks: element("ul", { className: "hint remarks" }),
    problem: element("p", { className: "problem" }),
    byHand: element("p", { className: "problem by-hand" }),
    halted: element("span", { className: "halted" }),
    run: element("div", { className: "run" }),
    whole: element("article", { className: "station" }),
    buttons: /** @type {Record<string, HTMLButtonElement>} */ ({}),
    strip: stripItem(name, title),
    /** What it shows.
     * @type {{session?: Session, safety?: Safety | null}} */
    known: {},
    session: /** @type {string | undefined} */ (undefined), // id of the one that runs
    seen: Date.now(),
  };
  parts.step.setAttribute("aria-live", "polite");
  parts.problem.setAttribute("role", "alert");
  parts.byHand.setAttribute("role", "alert");
  parts.bar.setAttribute("aria-label", `progress on ${title}`);
  const actions = element("p", { className: "actions" });
  const halts = element("p", { className: "actions" });
  parts.halted.setAttribute("role", "alert");
  /** @type {(label: string, className: string, action: () => Promise<unknown>, into?: HTMLElement) => void} */
  const does = (label, className, action, into = actions) => {
    const button = element("button", { textContent: label, className });
    button.setAttribute("aria-label", `${label}: ${title}`);
    button.addEventListener("click", told(parts.problem, async () => (await action(), follower())));
    parts.buttons[label] = button;
    into.append(button, " ");
  };
  does("Pause", "", () => post(`/sessions/${parts.session}/pause`));
  does("Resume", "", () => post(`/sessions/${parts.session}/resume`));
  does("Halt", "danger", () => (name ? halt(parts.halted, name) : post(`/sessions/${parts.session}/abort`)), halts);
  halts.append(parts.halted);
  halts.hidden = !(name ? mayHalt() : may("operate"));
  actions.hidden = !may("operate");
  parts.title.append(name ? element("a", { href: `#/stations/${encodeURIComponent(name)}`, textContent: title }) : title);
  parts.run.append(element("p", {}, parts.name), parts.bar, parts.step, parts.remarks, actions);
  /** @param {string} label @param {HTMLElement} value */
  const fact = (label, value) => element("div", {}, element("dt", { textContent: label }), value);
  const facts = element("dl", { className: "facts" }, fact("Shutter", parts.shutter), fact("Light", parts.light), fact("Sensor", parts.temperature));
  parts.whole.append(element("header", {}, parts.title, parts.state), facts, parts.run, halts, parts.byHand, parts.problem);
  return parts;
}

/** A station's line on every view.
 * @param {string | null} name @param {string} title */
function stripItem(name, title) {
  const link = element("a", { className: "name", textContent: name ?? title });
  const strip = { name: link, state: element("span", { className: "state" }), facts: element("span"), age: element("span", { className: "age" }), asks: asksBanner(() => link, () => follower(), name ?? title), whole: element("li") };
  strip.whole.append(element("span", {}, strip.name, " ", strip.state, " ", strip.facts, " ", strip.age));
  if (mayHalt() && name) {
    const button = named("button", "Halt", `${name}, now`, { className: "danger small" });
    button.addEventListener("click", () => halt($("halt-told"), name));
    strip.whole.append(button);
  }
  strip.whole.append(strip.asks.whole);
  $("strip").append(strip.whole);
  return strip;
}

/** What the line says, from what the card says.
 * @param {Parts} parts */
function showStrip(parts) {
  const { session, safety } = parts.known;
  const { strip } = parts;
  strip.name.href = session ? `#/sessions/${session.id}/live` : `#/stations/${encodeURIComponent(strip.name.textContent ?? "")}`;
  strip.state.textContent = parts.state.textContent;
  strip.state.className = parts.state.className;
  const [shutter, light] = [parts.shutter.textContent ?? "", parts.light.textContent];
  const screen = session?.state === "packing" ? "not in use" : session ? "in use" : safety?.state === "safe" ? "dark" : "not known";
  const words = [`shutter ${["–", "unknown"].includes(shutter) ? "state unknown" : shutter.startsWith("closed") ? "closed" : shutter}`, light === "–" ? "" : `light ${light}`, `screen ${screen}`];
  strip.facts.textContent = words.filter(Boolean).join(" · ");
  strip.facts.className = parts.shutter.className;
  showAge(parts);
}

/** @param {Parts} parts */
function showAge(parts) {
  const { session, safety } = parts.known;
  const at = session ? parts.seen : safety ? Date.parse(safety.at) : null;
  const seconds = at === null ? null : Math.max(0, (Date.now() - at) / 1000);
  parts.strip.age.textContent = seconds === null ? "" : `${duration(seconds)} old`;
  parts.strip.age.classList.toggle("old", Boolean(session) && seconds !== null && seconds > 60);
}
setInterval(() => document.hidden || cards.forEach(showAge), 1000);

/** @param {Parts} parts */
function forget(parts) {
  parts.whole.remove();
  parts.strip.whole.remove();
  parts.strip.asks.leave();
  forgetHalt(parts.halted);
}

/** @param {Parts} parts @param {Model<"BenchState"> | null} bench @param {Safety | null} [safety] */
function showBench(parts, bench, safety) {
  const open = bench?.shutter_open;
  parts.shutter.textContent = open == null ? "–" : open ? "open" : "closed";
  if (!bench) parts.shutter.textContent = !safety ? "unknown" : safety.shutter === "closed" ? `closed ${clock(safety.at)}` : { none: "none", unknown: "unknown" }[safety.shutter];
  parts.shutter.className = open || (!bench && safety?.shutter === "unknown") ? "open" : "";
  const nm = bench?.wavelength_nm;
  const lit = Object.entries(bench?.lamp_levels ?? {}).map(([channel, share]) => `${channel} at ${Number((100 * share).toFixed(1))} %`);
  const beam = nm == null ? "–" : nm === 0 ? "white" : `${Number(nm.toFixed(1))} nm`;
  parts.light.textContent = lit.length ? `light source: ${lit.join(", ")}` : beam;
  const warm = Object.entries(bench?.temperature_c ?? {}).map(([side, value]) => `${side} ${value.toFixed(1)} °C`);
  parts.temperature.textContent = warm.join(", ") || "–";
}

/** @param {Parts} parts @param {Model<"Progress">} p */
function showProgress(parts, p) {
  parts.bar.max = p.total || 1;
  parts.bar.value = p.done;
  const step = p.total && p.state === "running" ? `step ${Math.min(p.done + 1, p.total)} of ${p.total}` : "";
  parts.step.textContent = [p.what, step, left(p.left_s)].filter(Boolean).join(" · ");
  if (p.bench) showBench(parts, p.bench);
  parts.seen = Date.now();
  showStrip(parts);
  parts.strip.asks.show(p.session, p.asks);
  document.dispatchEvent(new CustomEvent("session-progress", { detail: { id: p.session, words: parts.step.textContent, done: p.done, total: p.total, asks: p.asks } }));
  if (p.remark && p.state !== "paused") parts.remarks.prepend(element("li", { textContent: `${p.what}: ${p.remark}` }));
}

/** @param {string} id @param {Parts} parts */
function follow(id, parts) {
  const stream = new EventSource(`${api}/sessions/${id}/events`);
  streams.set(id, stream);
  stream.addEventListener("progress", (event) => showProgress(parts, JSON.parse(event.data)));
  stream.addEventListener("state", (event) => {
    known.set(id, JSON.parse(event.data));
    follower();
  });
  stream.addEventListener("end", () => {
    stream.close();
    known.delete(id);
    streams.delete(id);
    follower();
  });
}

/** A station reads as free only where its instruments haven't said otherwise, and only while the service answers.
 * @param {Parts} parts */
function showState(parts) {
  const { session, safety } = parts.known;
  const unsafe = safety?.state === "not confirmed";
  const words = session?.state ?? (unsafe ? "NOT CONFIRMED: go to the bench" : safety?.state === "halting" ? "halting" : "free");
  parts.state.textContent = connected ? words : "not known: no connection";
  parts.state.className = `state ${connected && !(unsafe && !session) ? (session?.state ?? "") : "unsafe"}`;
  const waits = session?.state === "paused" ? session.error : ""; // for room on the disk
  parts.problem.textContent = (connected && (unsafe && !session ? safety.words : waits)) || "";
}

document.addEventListener("connection", (event) => {
  if (connected === event.detail) return;
  connected = event.detail;
  for (const parts of cards.values()) {
    showState(parts);
    showStrip(parts);
  }
});

// What an operator's hand changed and nobody put back: a station that captures so would capture something else.
/** @param {Parts} parts @param {string} name @param {Model<"LeftChanged">[]} left */
function showByHand(parts, name, left) {
  const words = left.map((one) => `${one.session}: ${one.words}`).join(" · ");
  if (parts.byHand.dataset.words === words) return;
  parts.byHand.dataset.words = words;
  parts.byHand.replaceChildren(words);
  if (!words || !may("operate")) return;
  const button = named("button", "It is put back", name);
  button.addEventListener("click", told(parts.problem, async () => (await post(`/stations/${encodeURIComponent(name)}/put-back`), follower())));
  parts.byHand.append(" ", button);
}

/** @param {Parts} parts @param {Session | undefined} session @param {Safety | null | undefined} safety @param {Model<"Question"> | null | undefined} asks */
function showRun(parts, session, safety, asks) {
  parts.strip.asks.show(session?.id, session && asks);
  parts.known = { session, safety };
  const begun = parts.session !== session?.id;
  parts.session = session?.id;
  parts.run.hidden = !session;
  showState(parts);
  parts.whole.classList.toggle("busy", Boolean(session));
  if (!session) {
    showBench(parts, null, safety);
    return showStrip(parts);
  }
  replace(parts.name, element("a", { href: `#/sessions/${session.id}/live`, textContent: session.name || session.id }));
  parts.buttons.Pause.disabled = session.state !== "running";
  parts.buttons.Resume.disabled = !["paused", "pausing"].includes(session.state);
  if (begun) {
    forgetHalt(parts.halted);
    parts.remarks.replaceChildren();
    parts.step.textContent = "";
    parts.bar.value = 0;
    parts.shutter.textContent = parts.light.textContent = "–";
  }
  if (streams.has(session.id)) return showStrip(parts);
  if (streams.size < STREAMS) follow(session.id, parts);
  if ("progress" in session && session.progress) showProgress(parts, session.progress);
  showStrip(parts);
}

/** The sessions that run on these stations; those of `sessions` may run elsewhere.
 * @param {Model<"StationState">[]} stations @param {Model<"ListedSession">[]} sessions */
async function running(stations, sessions) {
  const live = sessions.filter((s) => LIVE.includes(s.state));
  const ids = new Set([...stations.map((s) => s.busy_with).filter((id) => id != null), ...live.map((s) => s.id)]);
  for (const one of live) known.set(one.id, one);
  for (const id of known.keys()) if (!ids.has(id)) known.delete(id);
  await Promise.all([...ids].filter((id) => !streams.has(id)).map(async (id) => known.set(id, await ask(`/sessions/${id}`))));
  return [...ids].map((id) => known.get(id)).filter((one) => one !== undefined).filter((one) => LIVE.includes(one.state));
}

/** A card and a line for each station, and for each of `sessions` that runs somewhere else.
 * @param {Model<"StationState">[]} stations @param {Model<"ListedSession">[]} sessions */
export async function showStations(stations, sessions) {
  tellHalts(stations);
  const live = await running(stations, sessions);
  /** @type {Map<string, {title: string, name: string | null, safety?: Safety | null, left?: Model<"LeftChanged">[], session?: Session, asks?: Model<"Question"> | null}>} */
  const wanted = new Map();
  for (const one of stations.filter((s) => !s.problem)) {
    wanted.set(one.name, { title: one.title === one.name ? one.name : `${one.name}: ${one.title}`, name: one.name, safety: one.safety, left: one.left_by_hand, session: live.find((s) => s.id === one.busy_with), asks: one.asks });
  }
  const shown = new Set([...wanted.values()].map((one) => one.session?.id));
  for (const session of live) if (!shown.has(session.id)) wanted.set(session.id, { title: "elsewhere", name: null, session, asks: "asks" in session ? session.asks : null });
  for (const [id, parts] of cards) {
    if (wanted.has(id)) continue;
    forget(parts);
    cards.delete(id);
  }
  for (const [id, one] of wanted) {
    const parts = cards.get(id) ?? card(one.name, one.title);
    if (!cards.has(id)) {
      cards.set(id, parts);
      $("stations").append(parts.whole);
    }
    showRun(parts, one.session, one.safety, one.asks);
    if (one.name) showByHand(parts, one.name, one.session ? [] : (one.left ?? []));
  }
}

/** Cards stand at the desk; a station's own view has its card. One that stays where it is keeps the focus within it.
 * @param {string | null} own */
export function placeCards(own = null) {
  for (const [id, { whole }] of cards) {
    const place = $(id === own ? "station-run" : "stations");
    if (whole.parentElement !== place) place.append(whole);
  }
}

// --- a station ------------------------------------------------------------------------------------------------------

const CHECK_MS = 1000; // how often a check that is under way is looked at
let station = ""; // the name of the one that stands there
/** @type {Record<string, string>} */
const CLASSES = { works: "finished", fails: "failed" };

/** @param {Model<"DeviceState">} one */
function deviceRow(one) {
  const actions = element("td");
  if (may("operate")) {
    const button = named("button", "Check", one.name, { disabled: ["checking", "in use"].includes(one.state) });
    button.addEventListener("click", told("station-problem", () => check(one.name)));
    actions.append(button, " ");
  }
  if (one.transcript) actions.append(named("a", "Transcript", one.name, { href: one.transcript, target: "_blank", rel: "noopener" }));
  const state = element("td", {}, element("span", { className: `state ${CLASSES[one.state] ?? ""}`, textContent: one.state }));
  const words = one.words.replace(/^works, and /, ""); // the state above has said so
  if (words) state.append(element("div", { className: one.state === "fails" ? "reason" : "hint", textContent: words }));
  const made = element(
    "tr",
    {},
    element("td", { textContent: one.name }),
    element("td", { textContent: one.identity || "not told yet" }),
    element("td", { className: "small", textContent: `${one.driver} at ${one.address}` }),
    state,
    element("td", { className: "when", textContent: one.checked ? time(one.checked) : "never" }),
    actions,
  );
  return cells(made, "", "Identity", "Driver", "", "Last check");
}

async function showDevices() {
  const name = station;
  const found = await ask(`/stations/${encodeURIComponent(name)}/devices`);
  if (name !== station) return false;
  show("devices", found.map((one) => ({ id: one.name, ...one })), deviceRow);
  const counted = (/** @type {string} */ state) => found.filter((one) => one.state === state).length;
  const works = counted("works");
  const words = [works ? `${works} of ${found.length} work` : "", counted("fails") ? `${counted("fails")} fail` : "", counted("checking") ? `${counted("checking")} being checked` : ""];
  $("devices-told").textContent = words.filter(Boolean).join(", ") || "None was checked yet.";
  $("check-all").disabled = counted("checking") > 0 || counted("in use") > 0;
  return counted("checking") > 0;
}

/** Checks a device, or all where none is named.
 * @param {string | null} device */
async function check(device) {
  const asked = { transcript: $("keep-transcript").checked };
  const here = /** @type {const} */ (`/stations/${encodeURIComponent(station)}`);
  await (device ? post(`${here}/devices/${device}/check`, asked) : post(`${here}/check`, asked));
  while (await showDevices()) await new Promise((resolve) => setTimeout(resolve, CHECK_MS));
}
$("check-all").addEventListener("click", told("station-problem", () => check(null)));

addView({
  pattern: /^\/stations\/([^/]+)$/,
  section: "view-station",
  title: (name) => name,
  async show(first, name) {
    if (first) {
      station = name;
      $("station-title").textContent = name;
      $("station-problem").textContent = "";
      $("check-all").hidden = !may("operate");
      $("keep-transcript-label").hidden = !may("operate");
    }
    const one = await ask(`/stations/${encodeURIComponent(name)}`);
    $("station-title").textContent = one.title === name ? name : `${name}: ${one.title}`;
    $("station-problem").textContent = one.problem ?? "";
    /** @param {string} label @param {string} value */
    const fact = (label, value) => element("div", {}, element("dt", { textContent: label }), element("dd", { textContent: value }));
    $("station-facts").replaceChildren(fact("Cameras", one.cameras.join(", ")), fact("Targets", one.targets.join(", ") || "none"), fact("Sequences", one.sequences.join(", ") || "none"));
    $("station-sessions").href = `#/sessions?search=${encodeURIComponent(one.title)}`;
    placeCards(name);
    await showDevices();
  },
});
