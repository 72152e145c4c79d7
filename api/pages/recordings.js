// Recording sets: sent in by drag and drop or by the file chooser, worked on, fetched, deleted.

import { $, Problem, api, ask, element, post, show, told } from "./page.js";

let after = () => {};
let mayChange = false;

export function recordingsAre(scope, changed) {
  mayChange = ["calibrate", "admin"].includes(scope);
  after = changed;
  $("drop").hidden = !mayChange;
}

// fetch() tells nothing of how far a body was sent.
function send(file, tell) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    const format = $("drop-format").value;
    request.open("POST", `${api}/recordings${format ? `?format=${format}` : ""}`);
    request.setRequestHeader("Content-Type", file.name.endsWith(".tar") ? "application/x-tar" : /\.(tgz|gz)$/.test(file.name) ? "application/gzip" : "application/zip");
    request.upload.addEventListener("progress", (event) => event.lengthComputable && tell(event.loaded / event.total));
    request.addEventListener("error", () => reject(new Problem(`${file.name}: the connection broke off; send it again`)));
    request.addEventListener("load", () => {
      const answer = JSON.parse(request.responseText || "{}");
      if (request.status === 201) resolve(answer);
      else reject(new Problem(`${file.name}: ${answer.detail ?? request.status}`));
    });
    request.send(file);
  });
}

async function sendAll(files) {
  const bar = $("drop-bar");
  $("drop-told").textContent = "";
  const problems = [];
  bar.hidden = false;
  for (const file of files) {
    try {
      $("drop-told").textContent = `${file.name}: being sent`;
      const made = await send(file, (part) => {
        bar.value = part;
        if (part === 1) $("drop-told").textContent = `${file.name}: being checked`;
      });
      $("drop-told").textContent = [`${made.name || made.id}: ${made.captures} captures`, ...made.warnings].join("; ");
    } catch (error) {
      $("drop-told").textContent = "";
      problems.push(error.message);
    }
  }
  bar.hidden = true;
  await after();
  if (problems.length) throw new Problem(problems.join("; "));
}

const zone = $("drop");
for (const name of ["dragover", "dragleave", "drop"]) {
  zone.addEventListener(name, (event) => {
    event.preventDefault();
    zone.classList.toggle("over", name === "dragover");
  });
}
zone.addEventListener("drop", told("recordings-problem", (event) => {
  const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.());
  if (entries.some((entry) => entry?.isDirectory)) throw new Problem("pack the folder as a .zip or .tar and drop that");
  return sendAll([...event.dataTransfer.files]);
}));
$("drop-file").addEventListener("change", told("recordings-problem", async (event) => {
  const files = [...event.target.files];
  event.target.value = "";
  await sendAll(files);
}));

function row(one) {
  const actions = element("td");
  const does = (label, action) => {
    const button = element("button", { textContent: label });
    button.setAttribute("aria-label", `${label} ${one.name || one.id}`);
    button.addEventListener("click", told("recordings-problem", async () => (await action(), after())));
    actions.append(button, " ");
  };
  if (mayChange) for (const kind of ["fit", "diagnose", "report"]) does(kind[0].toUpperCase() + kind.slice(1), () => post(`/recordings/${one.id}/jobs`, { kind }));
  const link = element("a", { href: `${api}/recordings/${one.id}/archive.zip`, textContent: "Download" });
  link.setAttribute("aria-label", `Download ${one.name || one.id}`);
  actions.append(link, " ");
  if (mayChange) {
    does("Delete", async () => {
      if (confirm(`Delete ${one.name || one.id} for ever? Results of it stay.`)) await ask(`/recordings/${one.id}`, { method: "DELETE" });
    });
  }
  return element("tr", {}, element("td", { textContent: one.name || one.id, title: one.id }), element("td", { textContent: one.cameras.join(", ") }), element("td", { className: "number", textContent: one.captures }), actions);
}

export async function showRecordings() {
  const known = await ask("/recordings?limit=50");
  show("recordings", known, row);
  $("no-recordings").hidden = known.length > 0;
}
