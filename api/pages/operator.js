// The operator's page: what runs now, the sessions, the jobs and their reports. No framework: a few functions over fetch.

import { showCalibrations } from "./calibrations.js";
import { challengesAre, showChallenges } from "./challenges.js";
import { showFindings } from "./findings.js";
import { modelsAre, showModels } from "./models.js";
import { $, Problem, api, ask, element, post, put, show, time, told } from "./page.js";
import { asked as planned, showPlan } from "./plan.js";
import { queueIs, showQueue } from "./queue.js";
import { recordingsAre, showRecordings } from "./recordings.js";
import { leaveStations, showStations, stationsAre } from "./stations.js";
import { showWatched, watch, watches } from "./watch.js";

const PICTURES_AT_ONCE = 48;
let atOnce = PICTURES_AT_ONCE;
let selected = null; // the session whose captures are shown
let running = []; // the sessions that run now
let jobsDone = 0;
let scope = "read";

function exposure(seconds) {
  if (seconds == null) return "";
  return seconds < 1 ? ` · ${Number((seconds * 1e3).toPrecision(3))} ms` : ` · ${Number(seconds.toPrecision(3))} s`;
}

const guarded = (place, action) => async (event) => {
  await told(place, action)(event);
  await refresh();
};

// --- log in ---------------------------------------------------------------------------------------------------------

document.addEventListener("logged-out", () => showLogin());

function showLogin() {
  leaveStations();
  $("login").hidden = false;
  $("desk").hidden = $("logout").hidden = $("halt").hidden = true;
  $("who").textContent = "";
  $("login-form").elements.key.focus();
}

async function enter() {
  const me = await ask("/me");
  scope = me.scope;
  $("who").textContent = `${me.name} (${me.scope})`;
  $("login").hidden = true;
  $("desk").hidden = $("logout").hidden = false;
  $("halt").hidden = !["operate", "admin"].includes(me.scope);
  stationsAre(me.scope, () => refresh().catch(() => {}));
  queueIs(refresh);
  challengesAre(me.scope, refresh);
  recordingsAre(me.scope, async () => (await showRecordings(), await refresh()));
  modelsAre(me.scope);
  await refresh();
  await Promise.all([showCalibrations(), showRecordings(), showModels()]);
}

// --- starting -------------------------------------------------------------------------------------------------------

let stations = [];

function showStart() {
  const usable = stations.filter((s) => !s.problem);
  const select = $("start-form").elements.station;
  show("start-station", usable.map((s) => ({ id: s.name, title: s.title })), (s) => element("option", { value: s.id, textContent: s.title === s.id ? s.id : `${s.id}: ${s.title}` }));
  const problems = stations.filter((s) => s.problem).map((s) => `${s.name}: ${s.problem}`);
  if (!stations.length) problems.push("No station file yet: put one into the folder 'stations' of the data folder.");
  $("no-station").hidden = problems.length === 0;
  $("no-station").textContent = problems.join(" ");
  $("start-form").hidden = usable.length === 0 || !["operate", "admin"].includes(scope);
  const chosen = usable.find((s) => s.name === select.value);
  showStartButton(chosen);
  showPlan(chosen, $("start-form").elements.quick.checked).catch((error) => ($("plan-problem").textContent = error.message));
}

// A station that is busy, or a time, makes it a place in the queue.
function showStartButton(station) {
  const waits = station?.busy_with || $("start-form").elements.not_before.value;
  $("start").textContent = waits ? "Queue a session" : "Start a session";
}

$("start-form").addEventListener("change", () => showStart());
$("start-form").addEventListener(
  "submit",
  guarded("live-problem", async (event) => {
    const fields = event.target.elements;
    const at = fields.not_before.value ? new Date(fields.not_before.value).toISOString() : null;
    const queued = Boolean(at || stations.find((s) => s.name === fields.station.value)?.busy_with);
    const asked = { station: fields.station.value, name: fields.name.value, quick: fields.quick.checked, demands_certified: fields.certified.checked, ...planned() };
    const session = await post("/sessions", { ...asked, queue: queued, not_before: at });
    fields.name.value = fields.not_before.value = "";
    if (!queued) await select(session);
  }),
);

// Ends every session that runs, without a question: shutters close, screens go dark, each can be resumed, and the queue is held.
$("halt").addEventListener("click", guarded("live-problem", () => post("/halt")));

$("login-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target;
  const problem = form.querySelector(".problem");
  problem.textContent = "";
  const response = await fetch("/login", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ key: form.elements.key.value }),
  });
  form.reset();
  if (response.ok) await enter();
  else problem.textContent = (await response.json()).detail;
});

$("logout").addEventListener("click", async () => {
  await fetch("/logout", { method: "POST" });
  showLogin();
});

// A session that ended early goes on where its station is now: the file of that name may have other addresses.
async function goOn(session) {
  const [detail, stations] = await Promise.all([ask(`/sessions/${session.id}`), ask("/stations")]);
  const same = stations.filter((s) => !s.problem && s.title === detail.station);
  await post(`/sessions/${session.id}/resume`, { station: same.length === 1 ? same[0].name : null });
}

// --- tables ---------------------------------------------------------------------------------------------------------

function stateCell(item) {
  const cell = element("td", {}, element("span", { className: `state ${item.state}`, textContent: item.state }));
  if (item.error) cell.append(element("div", { className: "reason", textContent: item.error }));
  return cell;
}

function sessionRow(session) {
  const actions = element("td");
  if (["created", "interrupted", "failed"].includes(session.state)) {
    const resume = element("button", { textContent: "Resume" });
    resume.addEventListener("click", guarded("live-problem", () => goOn(session)));
    actions.append(resume, " ");
    const wait = element("button", { textContent: "Queue", title: "Resume it when its turn comes" });
    wait.addEventListener("click", guarded("live-problem", () => put(`/sessions/${session.id}/queue`, {})));
    actions.append(wait, " ");
  }
  const open = element("button", { textContent: "Open" });
  open.addEventListener("click", guarded("session-problem", () => select(session)));
  actions.append(open);
  return element(
    "tr",
    {},
    element("td", { textContent: session.name || session.id, title: session.id }),
    element("td", { className: "when", textContent: time(session.created) }),
    stateCell(session),
    element("td", { className: "number", textContent: `${session.steps_done}/${session.steps}` }),
    actions,
  );
}

function jobRow(job) {
  const actions = element("td");
  if (job.state === "running" || job.state === "queued") {
    const cancel = element("button", { textContent: "Cancel" });
    cancel.addEventListener("click", guarded("job-problem", () => post(`/jobs/${job.id}/cancel`)));
    actions.append(cancel);
  } else if (job.state === "done") {
    const made = job.challenge_id ? [] : ({ report: ["report"], pipeline: ["report", "result"] }[job.kind] ?? ["result"]);
    for (const what of made) {
      const label = what === "report" ? "Report" : "JSON";
      const link = { href: `${api}/jobs/${job.id}/${what}`, textContent: label, target: "_blank", rel: "noopener" };
      actions.append(element("a", link), " ");
    }
  }
  const state = stateCell(job);
  if (job.state === "running") {
    state.append(" ", element("progress", { max: 1, value: job.progress, className: "small" }));
    if (job.message) state.append(element("div", { className: "hint", textContent: job.message }));
  }
  return element(
    "tr",
    {},
    element("td", { textContent: job.kind.replace("-", " ") }),
    element("td", { textContent: job.of }),
    element("td", { className: "when", textContent: time(job.created) }),
    state,
    actions,
  );
}

// --- one session ----------------------------------------------------------------------------------------------------

async function select(session) {
  selected = session.id;
  atOnce = PICTURES_AT_ONCE;
  $("session").hidden = false;
  $("session-problem").textContent = "";
  $("session-title").textContent = session.name || session.id;
  const buttons = ["fit", "validate", "diagnose", "report", "pipeline"].map((kind) => {
    const button = element("button", { textContent: kind[0].toUpperCase() + kind.slice(1), title: `${kind} this session` });
    button.addEventListener(
      "click",
      guarded("session-problem", () => post(`/sessions/${session.id}/jobs`, { kind })),
    );
    return button;
  });
  const link = element("a", { href: `${api}/sessions/${session.id}/archive.zip`, textContent: "Download" });
  const away = element("button", { textContent: "Delete", className: "danger", hidden: scope !== "admin" });
  away.addEventListener("click", guarded("session-problem", () => deleteSession(session)));
  $("session-actions").replaceChildren(...[...buttons, link, away].flatMap((b) => [b, " "]));
  watch(session);
  const filter = $("capture-filter").elements;
  filter.kind.replaceChildren();
  await showCaptures();
  $("session").scrollIntoView({ block: "nearest" });
}

async function deleteSession(session) {
  if (!confirm(`Delete ${session.name || session.id} and all its captures for ever? Results and calibrations of it stay.`)) return;
  await ask(`/sessions/${session.id}`, { method: "DELETE" });
  selected = null;
  $("session").hidden = true;
  watch(null);
}

const option = (value) => element("option", { value, textContent: value || "all" });

// The captures that are shown, newest first as they were asked for; a live session adds those after the newest one only.
let captures = [];
let total = 0;
let shownFor = ""; // session and filter that `captures` are of

const filtered = () => {
  const filter = $("capture-filter").elements;
  const asked = new URLSearchParams({ limit: "200" });
  for (const key of ["kind", "side"]) if (filter[key].value) asked.set(key, filter[key].value);
  return asked;
};

async function page(asked) {
  const response = await fetch(`${api}/sessions/${selected}/captures?${asked}`);
  if (!response.ok) throw new Problem((await response.json()).detail);
  total = Number(response.headers.get("X-Total-Count"));
  return response.json();
}

async function showFilter() {
  const counts = (await ask(`/sessions/${selected}`)).captures;
  const filter = $("capture-filter").elements;
  for (const key of ["kind", "side"]) {
    const values = ["", ...new Set(counts.map((c) => c[key]))];
    const kept = filter[key].value;
    if (filter[key].options.length !== values.length) filter[key].replaceChildren(...values.map(option));
    filter[key].value = values.includes(kept) ? kept : "";
  }
}

async function showCaptures() {
  const wanted = `${selected} ${filtered()}`;
  if (shownFor !== wanted) {
    captures = [];
    await showFilter();
    const asked = filtered();
    asked.set("order", "newest");
    captures = await page(asked);
    shownFor = `${selected} ${filtered()}`;
  } else if (running.includes(selected)) {
    const known = captures.length;
    for (let more = true; more; ) {
      const asked = filtered();
      if (captures.length) asked.set("after", captures[0].id);
      const found = await page(asked);
      captures = [...found.reverse(), ...captures];
      more = found.length === 200;
    }
    if (known !== captures.length) await showFilter();
  }
  drawCaptures();
}

async function olderCaptures() {
  const asked = filtered();
  asked.set("order", "newest");
  asked.set("after", captures.at(-1).id);
  captures = [...captures, ...(await page(asked))];
}

function drawCaptures() {
  // Captures of one frame (an edge's regions, say) are one picture.
  const frames = new Map();
  for (const c of captures) frames.set(c.document.frame, [...(frames.get(c.document.frame) ?? []), c]);
  const pictures = [...frames.values()].map((of) => ({ ...of[0], more: of.length - 1 }));
  const shown = pictures.slice(0, atOnce);
  const left = pictures.length - shown.length + (captures.length < total ? 1 : 0);
  $("capture-count").textContent = total ? `${total} captures; ${shown.length} frames shown, the newest first` : "None yet.";
  $("more").hidden = left === 0;
  const stretch = $("capture-filter").elements.stretch.checked;
  show("captures", shown.map((c) => ({ ...c, picture: `${c.preview}?width=320${stretch ? "&stretch=true" : ""}` })), (c) =>
    element(
      "figure",
      {},
      element(
        "a",
        { href: `${c.picture.replace("width=320", "width=1600")}`, target: "_blank", rel: "noopener" },
        element("img", { loading: "lazy", src: c.picture, alt: `${c.kind}, ${c.side}` }),
      ),
      element("figcaption", { textContent: `${c.name}${c.more ? ` and ${c.more} more` : ""}${exposure(c.exposure_s)}` }),
    ),
  );
}

$("more").addEventListener(
  "click",
  guarded("session-problem", async () => {
    atOnce += PICTURES_AT_ONCE;
    if (captures.length < total) await olderCaptures();
    drawCaptures();
  }),
);
$("capture-filter").addEventListener("change", guarded("session-problem", showCaptures));

async function refresh() {
  if ($("desk").hidden) return;
  let sessions, jobs;
  [sessions, jobs, stations] = await Promise.all([ask("/sessions?limit=50"), ask("/jobs?limit=50"), ask("/stations")]);
  const names = new Map(sessions.map((s) => [s.id, s.name || s.id]));
  const live = await showStations(stations, sessions);
  const ended = running.includes(selected) && !live.some((s) => s.id === selected);
  running = live.map((s) => s.id);
  showStart();
  await showQueue();
  show("sessions", sessions, sessionRow);
  $("no-sessions").hidden = sessions.length > 0;
  const challenges = await showChallenges(jobs);
  const of = (job) => (job.challenge_id ? (challenges.get(job.challenge_id) ?? "a challenge") : (names.get(job.session_id) ?? job.session_id ?? `recordings ${job.recordings_id}`));
  show("jobs", jobs.map((job) => ({ ...job, of: of(job) })), jobRow);
  $("no-jobs").hidden = jobs.length > 0;
  const done = jobs.filter((job) => job.state === "done").length;
  if (done !== jobsDone) await Promise.all([showCalibrations(), showModels()]); // a fit is a new candidate
  jobsDone = done;
  if (!watches() && live.length) watch(live[0]);
  await showWatched();
  if (selected) await showFindings(selected, jobs.filter((job) => job.session_id === selected && job.state === "done").length);
  if (ended || running.includes(selected)) await showCaptures();
}

$("watch-side").addEventListener("change", () => showWatched().catch(() => {}));
// What runs tells of itself through its events; the lists are looked at now and then, and not where nobody sees them.
setInterval(() => document.hidden || refresh().catch(() => {}), 3000);
enter().catch(() => showLogin());
