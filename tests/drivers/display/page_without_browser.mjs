// The least of a browser that drivers/display/page.js needs, to run it as it is: node THIS ADDRESS PAGE ROWS COLS RATIO CANVAS_ROWS CANVAS_COLS
// Each painted canvas is told on standard output as its lit pixels: "painted COUNT FIRST_ROW FIRST_COL LAST_ROW LAST_COL".
import { pathToFileURL } from "node:url";

const [address, page, rows, cols, ratio, canvasRows, canvasCols] = process.argv.slice(2);
const canvas = { width: 0, height: 0, getContext: () => context };
const context = {
  createImageData: (width, height) => ({ width, data: new Uint8ClampedArray(4 * width * height) }),
  putImageData: ({ width, data }) => {
    const lit = [];
    new Uint32Array(data.buffer).forEach((value, at) => value === 0xffffffff && lit.push(at));
    const place = (at) => (at === undefined ? "- -" : `${Math.floor(at / width)} ${at % width}`);
    console.log(`painted ${lit.length} ${place(lit[0])} ${place(lit.at(-1))}`);
  },
};
const element = { textContent: "", classList: { toggle() {} }, addEventListener() {} };
globalThis.document = { getElementById: (id) => (id === "screen" ? canvas : element), body: element, documentElement: element };
globalThis.window = { devicePixelRatio: Number(ratio), ResizeObserverEntry: class { get devicePixelContentBoxSize() { return []; } } };
globalThis.ResizeObserverEntry = window.ResizeObserverEntry;
globalThis.screen = { height: Math.round(Number(rows) / Number(ratio)), width: Math.round(Number(cols) / Number(ratio)) }; // whole, as browsers tell it
globalThis.location = { host: address };
globalThis.requestAnimationFrame = (then) => setTimeout(then, 16);
globalThis.ResizeObserver = class {
  constructor(then) {
    this.then = then;
  }
  observe() {
    this.then([{ devicePixelContentBoxSize: [{ inlineSize: Number(canvasCols), blockSize: Number(canvasRows) }] }]);
  }
};
if (!globalThis.navigator) globalThis.navigator = { userAgent: "node" };
await import(pathToFileURL(page));
