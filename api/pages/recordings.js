// Recording sets: sent in by drag and drop or by the file chooser, worked on, fetched, deleted.

import { $, Listing, addView, api, cells, element, may, named, post, remove, told } from "./page.js";
import { takesFiles } from "./send.js";

takesFiles("drop", "recordings-problem", {
  path: () => {
    const format = $("drop-format").value;
    return `/recordings${format ? `?format=${format}` : ""}`;
  },
  words: (made) => [`${made.name || made.id}: ${made.captures} captures`, ...made.warnings].join("; "),
  after: () => list.refresh(),
});

/** @param {Model<"Recordings">} one */
function row(one) {
  const actions = element("td");
  /** @type {(label: string, action: () => Promise<unknown>) => void} */
  const does = (label, action) => {
    const button = named("button", label, one.name || one.id);
    button.addEventListener("click", told("recordings-problem", async () => (await action(), list.refresh())));
    actions.append(button, " ");
  };
  if (may("calibrate")) for (const kind of /** @type {const} */ (["fit", "diagnose", "report"])) does(kind[0].toUpperCase() + kind.slice(1), () => post(`/recordings/${one.id}/jobs`, { kind }));
  actions.append(named("a", "Download", one.name || one.id, { href: `${api}/recordings/${one.id}/archive.zip` }), " ");
  if (may("calibrate")) {
    does("Delete", async () => {
      if (confirm(`Delete ${one.name || one.id} for ever? Results of it stay.`)) await remove(`/recordings/${one.id}`);
    });
  }
  const made = element(
    "tr",
    {},
    element("td", {}, element("a", { href: `#/recordings/${one.id}`, textContent: one.name || one.id, title: one.id })),
    element("td", { textContent: one.cameras.join(", ") }),
    element("td", { className: "number", textContent: String(one.captures) }),
    actions,
  );
  return cells(made, "", "Cameras", "Captures");
}

/** @type {Listing<"/recordings">} */
const list = new Listing("recordings", "/recordings", row);

addView({
  pattern: /^\/recordings$/,
  section: "view-recordings",
  title: () => "Recording sets",
  show() {
    $("drop").hidden = !may("calibrate");
    return list.refresh();
  },
});
