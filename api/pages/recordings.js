// Recording sets: sent in by drag and drop or by the file chooser, worked on, fetched, deleted.

import { $, api, ask, element, may, post, show, told } from "./page.js";
import { takesFiles } from "./send.js";

let after = () => {};

export function recordingsAre(changed) {
  after = changed;
  $("drop").hidden = !may("calibrate");
}

takesFiles("drop", "recordings-problem", {
  path: () => {
    const format = $("drop-format").value;
    return `/recordings${format ? `?format=${format}` : ""}`;
  },
  words: (made) => [`${made.name || made.id}: ${made.captures} captures`, ...made.warnings].join("; "),
  after: () => after(),
});

function row(one) {
  const actions = element("td");
  const does = (label, action) => {
    const button = element("button", { textContent: label });
    button.setAttribute("aria-label", `${label} ${one.name || one.id}`);
    button.addEventListener("click", told("recordings-problem", async () => (await action(), after())));
    actions.append(button, " ");
  };
  if (may("calibrate")) for (const kind of ["fit", "diagnose", "report"]) does(kind[0].toUpperCase() + kind.slice(1), () => post(`/recordings/${one.id}/jobs`, { kind }));
  const link = element("a", { href: `${api}/recordings/${one.id}/archive.zip`, textContent: "Download" });
  link.setAttribute("aria-label", `Download ${one.name || one.id}`);
  actions.append(link, " ");
  if (may("calibrate")) {
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
