// Shows patterns that calibench sends, one canvas pixel on one screen pixel, and says when they are on the glass.

const canvas = document.getElementById("screen");
const hint = document.getElementById("hint");
const context = canvas.getContext("2d", { alpha: false });
let announced = null;
let pattern = null;
let socket = null;

// The browser tells the screen in whole CSS pixels: where the system scales by 1.5, that is off by up to half of one, and the
// canvas, which is measured in screen pixels, tells which screen it fills.
function pixels(css, ratio, canvas_px) {
  const off = Number.isInteger(ratio) ? 0 : ratio / 2;
  return Math.abs(css * ratio - canvas_px) <= off ? canvas_px : Math.round(css * ratio);
}

function geometry() {
  const ratio = window.devicePixelRatio;
  return {
    device_pixel_ratio: ratio,
    canvas_px: [canvas.height, canvas.width],
    screen_px: [pixels(screen.height, ratio, canvas.height), pixels(screen.width, ratio, canvas.width)],
  };
}

function filled() {
  const { canvas_px, screen_px } = geometry();
  return canvas_px[0] === screen_px[0] && canvas_px[1] === screen_px[1];
}

function tell(message) {
  if (socket && socket.readyState === WebSocket.OPEN) {
    socket.send(JSON.stringify({ ...message, ...geometry() }));
  }
}

function paint() {
  const image = context.createImageData(canvas.width, canvas.height);
  const pixels = new Uint32Array(image.data.buffer);
  pixels.fill(0xff000000);
  if (pattern) {
    const { rows, cols, cell_px, cells } = pattern;
    const top = Math.floor((canvas.height - rows * cell_px) / 2);
    const left = Math.floor((canvas.width - cols * cell_px) / 2);
    for (let y = 0; y < rows * cell_px; y++) {
      const from = Math.floor(y / cell_px) * cols;
      const to = (top + y) * canvas.width + left;
      for (let x = 0; x < cols * cell_px; x++) {
        if (cells[from + Math.floor(x / cell_px)]) pixels[to + x] = 0xffffffff;
      }
    }
  }
  context.putImageData(image, 0, 0);
}

function onGlass(then) {
  // The first callback comes before the frame that has the new pixels, the second after it was handed over.
  requestAnimationFrame(() => requestAnimationFrame(then));
}

function show(request, cells) {
  const { id, rows, cols, cell_px } = request;
  const [height, width] = geometry().canvas_px;
  if (!filled()) {
    tell({ type: "refused", id, reason: "the page doesn't fill the screen, so one canvas pixel isn't one screen pixel; make it full-screen (click it, or F11) at a browser zoom of 100 %" });
    return;
  }
  if (rows * cell_px > height || cols * cell_px > width) {
    tell({ type: "refused", id, reason: `${rows * cell_px} x ${cols * cell_px} px don't fit a screen of ${height} x ${width} px; ask for smaller cells` });
    return;
  }
  pattern = rows ? { rows, cols, cell_px, cells } : null;
  paint();
  onGlass(() => tell({ type: "shown", id, cell_px }));
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/ws`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    tell({ type: "page", user_agent: navigator.userAgent });
    update();
  };
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") announced = JSON.parse(data);
    else if (announced) {
      show(announced, new Uint8Array(data));
      announced = null;
    }
  };
  socket.onclose = () => {
    update();
    setTimeout(connect, 500);
  };
}

function update() {
  const open = socket && socket.readyState === WebSocket.OPEN;
  document.body.classList.toggle("ready", Boolean(open && filled()));
  hint.textContent = open ? "Click to fill this screen." : "Waiting for calibench.";
}

new ResizeObserver(([entry]) => {
  const box = entry.devicePixelContentBoxSize?.[0];
  canvas.width = box ? box.inlineSize : Math.round(entry.contentRect.width * window.devicePixelRatio);
  canvas.height = box ? box.blockSize : Math.round(entry.contentRect.height * window.devicePixelRatio);
  paint();
  update();
  tell({ type: "page", user_agent: navigator.userAgent });
}).observe(canvas, "ResizeObserverEntry" in window && "devicePixelContentBoxSize" in ResizeObserverEntry.prototype ? { box: "device-pixel-content-box" } : {});

document.body.addEventListener("click", () => document.documentElement.requestFullscreen());
connect();
