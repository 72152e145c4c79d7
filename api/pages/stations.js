// Stations at a glance: a card each, with what runs there, its shutter, light and temperature, and a halt.

import { $, LIVE, api, ask, clock, duration, element, forgetHalt, halt, may, mayHalt, post, tellHalts, told } from "./page.js";

// A browser keeps six connections to a service open; the streams leave some of them for requests.
const STREAMS = 3;
const cards = new Map(); // key of the card -> its parts
const streams = new Map(); // session -> its event stream
let follower = () => {};
let connected = true;

export function stationsAre(ended) {
  follower = ended;
}

export function leaveStations() {
  for (const parts of cards.values()) parts.whole.remove();
  cards.clear(); // another key may do other things
  for (const stream of streams.values()) stream.close();
  streams.clear();
}

const left = (seconds) => (seconds == null ? "" : `${duration(seconds)} left`);

function card(name, title) {
  const at = (tag, className, ...children) => element(tag, { className }, ...children);
  const parts = {
    title: element("h3", { textContent: title }),
    state: at("span", "state"),
    shutter: element("dd"),
    light: element("dd"),
    temperature: element("dd"),
    name: element("strong"),
    bar: element("progress", { max: 1, value: 0 }),
    step: at("p", "step"),
    remarks: at("ul", "hint remarks"),
    problem: at("p", "problem"),
    buttons: {},
  };
  parts.step.setAttribute("aria-live", "polite");
  parts.problem.setAttribute("role", "alert");
  parts.bar.setAttribute("aria-label", `progress on ${title}`);
  const actions = at("p", "actions");
  const halts = at("p", "actions");
  parts.halted = at("span", "halted");
  parts.halted.setAttribute("role", "alert");
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
  parts.run = at("div", "run", element("p", {}, parts.name), parts.bar, parts.step, parts.remarks, actions);
  const fact = (label, value) => element("div", {}, element("dt", { textContent: label }), value);
  const facts = element("dl", { className: "facts" }, fact("Shutter", parts.shutter), fact("Light", parts.light), fact("Sensor", parts.temperature));
  parts.whole = element("article", { className: "station" }, element("header", {}, parts.title, parts.state), facts, parts.run, halts, parts.problem);
  return parts;
}

function showBench(parts, bench, safety) {
  const open = bench?.shutter_open;
  parts.shutter.textContent = open == null ? "–" : open ? "open" : "closed";
  if (!bench) parts.shutter.textContent = !safety ? "not asked yet" : safety.shutter === "closed" ? `closed ${clock(safety.at)}` : { none: "none", unknown: "unknown" }[safety.shutter];
  parts.shutter.className = open || (!bench && safety?.shutter === "unknown") ? "open" : "";
  const nm = bench?.wavelength_nm;
  parts.light.textContent = nm == null ? "–" : nm === 0 ? "white" : `${Number(nm.toFixed(1))} nm`;
  const warm = Object.entries(bench?.temperature_c ?? {}).map(([side, value]) => `${side} ${value.toFixed(1)} °C`);
  parts.temperature.textContent = warm.join(", ") || "–";
}

function showProgress(parts, p) {
  parts.bar.max = p.total || 1;
  parts.bar.value = p.done;
  const step = p.total && p.state === "running" ? `step ${Math.min(p.done + 1, p.total)} of ${p.total}` : "";
  parts.step.textContent = [p.what, step, left(p.left_s)].filter(Boolean).join(" · ");
  if (p.bench) showBench(parts, p.bench);
  if (p.remark) parts.remarks.prepend(element("li", { textContent: `${p.what}: ${p.remark}` }));
}

function follow(id, parts) {
  const stream = new EventSource(`${api}/sessions/${id}/events`);
  streams.set(id, stream);
  stream.addEventListener("progress", (event) => showProgress(parts, JSON.parse(event.data)));
  stream.addEventListener("state", () => follower());
  stream.addEventListener("end", () => {
    stream.close();
    streams.delete(id);
    follower();
  });
}

// A station reads as free only where its instruments haven't said otherwise, and only while the service answers.
function showState(parts) {
  const { session, safety } = parts.known;
  const unsafe = safety?.state === "not confirmed";
  const words = session?.state ?? (unsafe ? "NOT CONFIRMED: go to the bench" : safety?.state === "halting" ? "halting" : "free");
  parts.state.textContent = connected ? words : "not known: no connection";
  parts.state.className = `state ${connected && !(unsafe && !session) ? (session?.state ?? "") : "unsafe"}`;
  parts.problem.textContent = connected && unsafe && !session ? safety.words : "";
}

document.addEventListener("connection", (event) => {
  if (connected === event.detail) return;
  connected = event.detail;
  for (const parts of cards.values()) showState(parts);
});

async function showRun(parts, session, safety) {
  parts.known = { session, safety };
  const begun = parts.session !== session?.id;
  parts.session = session?.id;
  parts.run.hidden = !session;
  showState(parts);
  parts.whole.classList.toggle("busy", Boolean(session));
  if (!session) return showBench(parts, null, safety);
  parts.name.textContent = session.name || session.id;
  parts.buttons.Pause.disabled = session.state !== "running";
  parts.buttons.Resume.disabled = !["paused", "pausing"].includes(session.state);
  if (begun) {
    forgetHalt(parts.halted);
    parts.remarks.replaceChildren();
    parts.step.textContent = "";
    parts.bar.value = 0;
  }
  if (streams.has(session.id)) return;
  if (streams.size < STREAMS) return follow(session.id, parts);
  const progress = (await ask(`/sessions/${session.id}`)).progress;
  if (progress) showProgress(parts, progress);
}

// A card for each station, and one for each session that runs somewhere else.
export async function showStations(stations, sessions) {
  tellHalts(stations);
  const running = sessions.filter((s) => LIVE.includes(s.state));
  const wanted = new Map();
  for (const one of stations.filter((s) => !s.problem)) {
    wanted.set(one.name, { title: one.title === one.name ? one.name : `${one.name}: ${one.title}`, name: one.name, safety: one.safety, session: running.find((s) => s.id === one.busy_with) });
  }
  const shown = new Set([...wanted.values()].map((one) => one.session?.id));
  for (const session of running) if (!shown.has(session.id)) wanted.set(session.id, { title: "elsewhere", name: null, session });
  for (const [id, parts] of cards) {
    if (!wanted.has(id)) {
      parts.whole.remove();
      forgetHalt(parts.halted);
      cards.delete(id);
    }
  }
  for (const [id, one] of wanted) {
    if (!cards.has(id)) {
      cards.set(id, card(one.name, one.title));
      $("stations").append(cards.get(id).whole);
    }
    await showRun(cards.get(id), one.session, one.safety);
  }
  return running;
}
