// One session, or one recording set that was sent in: live, findings, figures, frames and jobs, each at its own address.

import { showFrames, leaveFrames } from "./frames.js";
import { showFindings } from "./findings.js";
import { figureRow, searchIn } from "./figures.js";
import { showOwnJobs } from "./jobs.js";
import { $, LIVE, addView, api, ask, change, element, goTo, may, named, post, show, showView, time, told } from "./page.js";
import { actionsOf, verdictWords } from "./sessions.js";
import { showWatched, watch } from "./watch.js";

const TABS = { live: "Live", findings: "Findings", figures: "Figures", frames: "Frames", jobs: "Jobs" };
const tabsOf = (kind) => Object.keys(TABS).filter((tab) => kind === "sessions" || tab !== "live");

let shown = ""; // the source that stands there
let noted = ""; // its name and notes as the form has them

const fact = (label, value) => (value ? [element("div", {}, element("dt", { textContent: label }), element("dd", {}, value))] : []);

function showHead(source, one) {
  const name = one.name || one.id;
  $("session-title").textContent = name;
  const stations = one.station ? element("a", { href: `#/sessions?search=${encodeURIComponent(one.station)}`, textContent: one.station }) : "";
  const cameras = Array.isArray(one.cameras) ? one.cameras.join(", ") : Object.values(one.cameras ?? {}).join(", ");
  const facts = [
    ...fact("Id", one.id),
    ...fact("State", one.state && element("span", { className: `state ${one.state}`, textContent: one.state })),
    ...fact("Station", stations),
    ...fact("Cameras", cameras),
    ...fact("Begun (UTC)", time(one.created)),
    ...fact("Steps", one.steps === undefined ? "" : `${one.steps_done} of ${one.steps}`),
    ...fact("Captures", source.kind === "recordings" ? String(one.captures) : String(one.captures.reduce((sum, each) => sum + each.captures, 0))),
    ...fact("Verdict", verdictWords(one.verdict)),
    ...fact("Calibration", one.results?.fit ? element("a", { href: `#/calibrations/${one.results.fit}`, textContent: one.results.fit }) : ""),
  ];
  $("session-facts").replaceChildren(...facts);
  $("session-error").textContent = one.error ?? "";
  $("session-then").textContent = one.then ? `Then: ${one.then.words}` : "";
  const form = $("session-notes");
  form.hidden = source.kind !== "sessions" || !may("operate");
  const now = JSON.stringify([one.id, one.name, one.notes]);
  if (now !== noted && !form.contains(document.activeElement)) {
    noted = now;
    form.elements.name.value = one.name;
    form.elements.notes.value = one.notes;
  }
}

const JOBS = { sessions: ["fit", "validate", "diagnose", "report", "pipeline"], recordings: ["fit", "validate", "diagnose", "report"] };

function showActions(source, one) {
  const name = one.name || one.id;
  const again = () => showView();
  const made = [];
  const does = (label, action, properties = {}) => {
    const button = named("button", label, name, properties);
    button.addEventListener("click", told("session-problem", async () => (await action(), await again())));
    made.push(button);
  };
  for (const [label, action, title] of source.kind === "sessions" ? actionsOf(one) : []) does(label, action, { title });
  if (LIVE.includes(one.state) && may("operate")) {
    does("Pause", () => post(`/sessions/${one.id}/pause`), { disabled: one.state !== "running" });
    does("Resume", () => post(`/sessions/${one.id}/resume`), { disabled: !["paused", "pausing"].includes(one.state) });
    does("Abort", () => post(`/sessions/${one.id}/abort`), { className: "danger" });
  }
  if (may("calibrate") && (source.kind === "recordings" || one.state === "finished")) {
    for (const kind of JOBS[source.kind]) does(kind[0].toUpperCase() + kind.slice(1), () => post(`/${source.kind}/${one.id}/jobs`, { kind }));
  }
  if (may("admin") && one.state === "finished") does("Resolve", () => post(`/sessions/${one.id}/jobs`, { kind: "pipeline", resolve: true }), { title: "The whole pipeline; while rivals are left, take the capture that tells them apart" });
  if (source.kind === "recordings" || ["finished", "interrupted", "failed"].includes(one.state)) made.push(named("a", "Download", name, { href: `${api}/${source.kind}/${one.id}/archive.zip` }));
  if (one.can_copy && may("operate")) made.push(named("a", "Copy to the start form", name, { href: `#/?copy=${one.id}` }));
  if (may(source.kind === "sessions" ? "admin" : "calibrate") && !LIVE.includes(one.state)) {
    const away = named("button", "Delete", name, { className: "danger" });
    away.addEventListener("click", told("session-problem", async () => {
      const kept = source.kind === "sessions" ? "and all its captures for ever? Results and calibrations of it stay." : "for ever? Results of it stay.";
      if (!confirm(`Delete ${name} ${kept}`)) return;
      await ask(`/${source.kind}/${one.id}`, { method: "DELETE" });
      goTo(`/${source.kind}`);
    }));
    made.push(away);
  }
  show("session-actions", [{ id: 0, of: made.map((button) => [button.textContent, button.disabled, one.id]) }], () => element("span", { className: "actions" }, ...made.flatMap((button) => [button, " "])));
}

$("session-notes").addEventListener("submit", told("session-problem", async (event) => {
  const fields = event.target.elements;
  await change(`/sessions/${shown.split("/")[1]}`, { name: fields.name.value, notes: fields.notes.value });
  document.activeElement.blur();
  await showView();
}));

// --- figures --------------------------------------------------------------------------------------------------------

let figures = [];
let figuresOf = "";

const drawFigures = searchIn("figures-search", () => figures, (found) => {
  show("figures", found, figureRow);
  $("no-figures").textContent = found.length ? "" : figures.length ? "None is like that." : "Not fitted yet: start a fit above.";
});

async function showFigures(source, fit) {
  const wanted = `${source.kind}/${source.id} ${fit ?? ""}`;
  if (figuresOf !== wanted) {
    figures = fit ? await ask(`/${source.kind}/${source.id}/figures`) : [];
    figuresOf = wanted;
  }
  drawFigures();
}

// --- the view -------------------------------------------------------------------------------------------------------

async function showSource(first, kind, id, tab) {
  const source = { kind, id };
  if (shown !== `${kind}/${id}`) $("session-title").textContent = id;
  const one = await ask(`/${kind}/${id}`);
  const tabs = tabsOf(kind);
  const usual = kind === "recordings" ? "findings" : LIVE.includes(one.state) ? "live" : one.results.diagnose ? "findings" : "frames";
  const at = tabs.includes(tab) ? tab : usual;
  if (first || shown !== `${kind}/${id}`) {
    if (shown !== `${kind}/${id}`) leaveFrames();
    shown = `${kind}/${id}`;
    $("session-problem").textContent = "";
    $("session-tabs").replaceChildren(...tabs.map((name) => {
      const link = element("a", { href: `#/${kind}/${id}/${name}`, textContent: TABS[name] });
      if (name === at) link.setAttribute("aria-current", "page");
      return link;
    }));
    for (const name of Object.keys(TABS)) $(`panel-${name}`).hidden = name !== at;
    watch(at === "live" ? one : null);
  }
  showHead(source, one);
  document.title = `${one.name || one.id} · ${TABS[at]} · calibench`;
  showActions(source, one);
  if (at === "live") await showWatched();
  else if (at === "findings") await showFindings(source, one.results.diagnose);
  else if (at === "figures") await showFigures(source, one.results.fit);
  else if (at === "frames") await showFrames(source, one);
  else await showOwnJobs(source, one.name || one.id);
}

for (const kind of ["sessions", "recordings"]) {
  addView({
    pattern: new RegExp(`^/${kind}/([0-9A-Za-z-]+)(?:/(${tabsOf(kind).join("|")}))?$`),
    section: "view-source",
    title: (id) => id,
    show: (first, id, tab) => showSource(first, kind, id, tab),
  });
}
