// Places where archives are dropped or chosen, and sent to the service one after the other.

import { $, Problem, api, said, told } from "./page.js";

/** Sends a file; fetch() tells nothing of how far a body was sent.
 * @param {File} file
 * @param {string} path
 * @param {(part: number) => void} tell
 * @returns {Promise<any>} */
function send(file, path, tell) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", api + path);
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

/** Takes the files that are dropped on a place or chosen there.
 * `id`: of the place; its file chooser, progress bar and line have `-file`, `-bar` and `-told` after it. `path()`: where archives are sent;
 * `words(made)`: what is told of one that was taken in; `after()`: shows the list anew. What goes wrong stands in `problem`.
 * @template Made
 * @param {"drop" | "model-drop"} id
 * @param {keyof Elements} problem
 * @param {{path: () => string, words: (made: Made) => string, after: () => unknown}} of */
export function takesFiles(id, problem, { path, words, after }) {
  /** @type {HTMLElement} */
  const zone = $(id);
  const bar = $(`${id}-bar`);
  const line = $(`${id}-told`);

  /** @param {File[]} files */
  async function sendAll(files) {
    const problems = [];
    line.textContent = "";
    bar.hidden = false;
    for (const file of files) {
      try {
        line.textContent = `${file.name}: being sent`;
        const made = await send(file, path(), (part) => {
          bar.value = part;
          if (part === 1) line.textContent = `${file.name}: being checked`;
        });
        line.textContent = words(made);
      } catch (error) {
        line.textContent = "";
        problems.push(said(error));
      }
    }
    bar.hidden = true;
    await after();
    if (problems.length) throw new Problem(problems.join("; "));
  }

  for (const name of ["dragover", "dragleave", "drop"]) {
    zone.addEventListener(name, (event) => {
      event.preventDefault();
      zone.classList.toggle("over", name === "dragover");
    });
  }
  zone.addEventListener("drop", told(problem, (/** @type {DragEvent} */ event) => {
    const entries = [...(event.dataTransfer?.items ?? [])].map((item) => item.webkitGetAsEntry?.());
    if (entries.some((entry) => entry?.isDirectory)) throw new Problem("pack the folder as a .zip or .tar and drop that");
    return sendAll([...(event.dataTransfer?.files ?? [])]);
  }));
  const chooser = $(`${id}-file`);
  chooser.addEventListener("change", told(problem, async () => {
    const files = [...(chooser.files ?? [])];
    chooser.value = "";
    await sendAll(files);
  }));
}
