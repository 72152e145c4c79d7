// Camera models: those of fits and diagnoses, and those that are sent in; fetched, and the sent ones deleted.

import { $, Listing, addView, api, cells, element, may, named, remove, time, told } from "./page.js";
import { takesFiles } from "./send.js";

/** @param {Record<string, {name: string}>} cameras */
const names = (cameras) => Object.entries(cameras).map(([side, camera]) => `${side} camera ${camera.name}`.trim());

takesFiles("model-drop", "models-problem", {
  path: () => "/camera-models",
  words: (made) => `${made.id}: ${names(made.cameras).join(", ")}`,
  after: () => list.refresh(),
});

/** @param {Model<"CameraModels">} one */
function row(one) {
  const actions = element("td");
  if (one.sides.length) {
    actions.append(named("a", "Download", `camera model ${one.id}`, { href: `${api}/camera-models/${one.id}/archive.zip` }), " ");
  }
  if (may("calibrate") && one.kind === "sent") {
    const button = named("button", "Delete", `camera model ${one.id}`);
    button.addEventListener("click", told("models-problem", async () => {
      if (!confirm(`Delete camera model ${one.id} for ever?`)) return;
      await remove(`/camera-models/${one.id}`);
      await list.refresh();
    }));
    actions.append(button);
  }
  const of = one.session_id ? `sessions/${one.session_id}` : `recordings/${one.recordings_id}`;
  const made = element(
    "tr",
    {},
    element("td", {}, one.sides.length ? element("a", { href: `#/models/${one.id}`, textContent: one.id }) : one.id),
    element("td", { textContent: one.kind }),
    element("td", {}, one.kind === "sent" ? "" : element("a", { href: `#/${of}`, textContent: one.session_id ?? one.recordings_id ?? "" })),
    element("td", { textContent: one.sides.join(", ") || "not kept" }),
    element("td", { className: "when", textContent: time(one.created) }),
    actions,
  );
  return cells(made, "", "Kind", "Of", "Cameras", "Kept");
}

/** @type {Listing<"/camera-models">} */
const list = new Listing("models", "/camera-models", row);

addView({
  pattern: /^\/models$/,
  section: "view-models",
  title: () => "Camera models",
  show() {
    $("model-drop").hidden = !may("calibrate");
    return list.refresh();
  },
});
