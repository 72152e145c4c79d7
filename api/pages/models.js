// Camera models: those of fits and diagnoses, and those that are sent in; fetched, and the sent ones deleted.

import { $, api, ask, element, may, show, time, told } from "./page.js";
import { takesFiles } from "./send.js";

export function modelsAre() {
  $("model-drop").hidden = !may("calibrate");
}

const names = (cameras) => Object.entries(cameras).map(([side, camera]) => `${side} camera ${camera.name}`.trim());

takesFiles("model-drop", "models-problem", {
  path: () => "/camera-models",
  words: (made) => `${made.id}: ${names(made.cameras).join(", ")}`,
  after: showModels,
});

function row(one) {
  const actions = element("td");
  if (one.sides.length) {
    const link = element("a", { href: `${api}/camera-models/${one.id}/archive.zip`, textContent: "Download" });
    link.setAttribute("aria-label", `Download camera model ${one.id}`);
    actions.append(link, " ");
  }
  if (may("calibrate") && one.kind === "sent") {
    const button = element("button", { textContent: "Delete" });
    button.setAttribute("aria-label", `Delete camera model ${one.id}`);
    button.addEventListener("click", told("models-problem", async () => {
      if (!confirm(`Delete camera model ${one.id} for ever?`)) return;
      await ask(`/camera-models/${one.id}`, { method: "DELETE" });
      await showModels();
    }));
    actions.append(button);
  }
  return element(
    "tr",
    {},
    element("td", { textContent: one.id }),
    element("td", { textContent: one.kind }),
    element("td", { textContent: one.session_id ?? one.recordings_id ?? "" }),
    element("td", { textContent: one.sides.join(", ") || "not kept" }),
    element("td", { className: "when", textContent: time(one.created) }),
    actions,
  );
}

export async function showModels() {
  const known = await ask("/camera-models?limit=50");
  show("models", known, row);
  $("no-models").hidden = known.length > 0;
}
