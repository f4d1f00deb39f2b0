"use strict";
// The 3D clouds: points set by hand into a 2D canvas with a depth buffer (no WebGL, no library), boxes drawn over them.
const AugCloud = (() => {
  const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
  const VIEWS = {
    behind: { yaw: 0, pitch: 0.42, distance: 30, target: [17, 0, -1.2] },
    above: { yaw: 0, pitch: 1.5, distance: 62, target: [28, 0, 0] },
    side: { yaw: Math.PI / 2, pitch: 0.25, distance: 42, target: [18, 0, 0] },
    driver: { yaw: 0, pitch: 0.03, distance: 6, target: [6, 0, 0] },
  };
  const palettes = JSON.parse(document.getElementById("palettes").textContent);

  const bytesOf = (text) => {
    const raw = atob(text);
    const bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return bytes;
  };

  const unpack = (record) => {
    const n = record.count, bytes = bytesOf(record.data);
    const words = new DataView(bytes.buffer);
    const places = [0, 1, 2].map((axis) => {
      const values = new Float32Array(n), step = record.span[axis] / 65535;
      for (let i = 0; i < n; i++) values[i] = record.low[axis] + step * words.getUint16(2 * (axis * n + i), true);
      return values;
    });
    const colourings = {};
    record.colourings.forEach((name, k) => { colourings[name] = bytes.subarray(6 * n + k * n, 6 * n + (k + 1) * n); });
    return { n, places, colourings };
  };

  const pack = ([r, g, b]) => (255 << 24) | (b << 16) | (g << 8) | r;
  const onRamp = (ramp, share) => {
    const at = Math.min(Math.max(share, 0), 1) * (ramp.length - 1), i = Math.min(Math.floor(at), ramp.length - 2);
    return ramp[i].map((value, c) => Math.round(value + (ramp[i + 1][c] - value) * (at - i)));
  };

  // Byte value -> colour of a colouring that the page carries.
  const table = (palette) => {
    const colours = new Uint32Array(256).fill(pack([110, 110, 110]));
    if (palette.ramp) for (let i = 0; i <= palette.last; i++) colours[i] = pack(onRamp(palette.ramp, i / palette.last));
    for (const [value, [, rgb]] of Object.entries(palette.names || {})) colours[Number(value)] = pack(rgb);
    return colours;
  };

  const coloursOf = (cloud, name) => {
    const palette = palettes[name], colours = new Uint32Array(cloud.n), [x, y, z] = cloud.places;
    if (cloud.colourings[name]) {
      const of = table(palette), bytes = cloud.colourings[name];
      for (let i = 0; i < cloud.n; i++) colours[i] = of[bytes[i]];
      return colours;
    }
    const steps = Array.from({ length: 256 }, (_, i) => pack(onRamp(palette.ramp, i / 255)));
    for (let i = 0; i < cloud.n; i++) {
      const share = name === "height" ? (z[i] + 2.5) / 5 : Math.log(Math.max(Math.hypot(x[i], y[i]), 2) / 2) / Math.log(40);
      colours[i] = steps[Math.round(255 * Math.min(Math.max(share, 0), 1))];
    }
    return colours;
  };

  const legend = (cloud, name) => {
    const palette = palettes[name], parts = [], used = new Set(cloud.colourings[name] || []);
    if (palette.ramp) {
      const stops = palette.ramp.map((rgb) => `rgb(${rgb})`).join(",");
      parts.push(`<span>${palette.low}</span><i class="ramp" style="background:linear-gradient(to right,${stops})"></i><span>${palette.high}</span>`);
    }
    for (const [value, [text, rgb]] of Object.entries(palette.names || {})) {
      if (used.has(Number(value))) parts.push(`<span class="dot"><i style="background:rgb(${rgb})"></i>${text}</span>`);
    }
    return parts.join("");
  };

  class View {
    constructor(holder) {
      this.holder = holder;
      this.canvas = holder.querySelector("canvas");
      this.context = this.canvas.getContext && this.canvas.getContext("2d");
      if (!this.context) throw new Error("no canvas");
      const record = JSON.parse(holder.querySelector("script").textContent);
      this.cloud = unpack(record);
      this.boxes = record.boxes;
      this.waiting = false;
      this.look("behind");
      this.colour(record.colourings.includes(holder.dataset.colour) ? holder.dataset.colour : "source");
      this.listen();
    }

    look(name) {
      const { yaw, pitch, distance, target } = VIEWS[name];
      Object.assign(this, { yaw, pitch, distance, target: [...target] });
      this.soon();
    }

    colour(name) {
      this.holder.dataset.colour = name;
      this.colours = coloursOf(this.cloud, name);
      this.holder.querySelector(".cloud-legend").innerHTML = legend(this.cloud, name);
      const select = this.holder.querySelector("select.colouring");
      if (select) select.value = name;
      this.soon();
    }

    soon() {
      if (this.waiting) return;
      this.waiting = true;
      requestAnimationFrame(() => { this.waiting = false; this.draw(); });
    }

    axes() {
      const cy = Math.cos(this.yaw), sy = Math.sin(this.yaw), cp = Math.cos(this.pitch), sp = Math.sin(this.pitch);
      return { forward: [cp * cy, cp * sy, -sp], right: [sy, -cy, 0], up: [cy * sp, sy * sp, cp] };
    }

    draw() {
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      const width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
      if (!width || !height) return;
      if (this.canvas.width !== width || this.canvas.height !== height) {
        this.canvas.width = width;
        this.canvas.height = height;
        this.depth = new Float32Array(width * height);
      }
      const { forward: f, right: r, up: u } = this.axes(), eye = this.target.map((value, k) => value - this.distance * f[k]);
      const place = (x, y, z) => {
        const a = x - eye[0], b = y - eye[1], c = z - eye[2], d = a * f[0] + b * f[1] + c * f[2];
        const scale = (0.85 * Math.max(width, 1.5 * height)) / Math.max(d, 0.01);
        return [width / 2 + scale * (a * r[0] + b * r[1]), height / 2 - scale * (a * u[0] + b * u[1] + c * u[2]), d];
      };
      this.points(place, width, height, ratio);
      this.lines(place, ratio);
      this.holder.dataset.drawn = String(Number(this.holder.dataset.drawn || 0) + 1);
    }

    points(place, width, height, ratio) {
      const picture = this.context.createImageData(width, height), out = new Uint32Array(picture.data.buffer);
      const depth = this.depth.fill(Infinity), [x, y, z] = this.cloud.places, colours = this.colours;
      out.fill(pack([17, 21, 28]));
      for (let i = 0; i < this.cloud.n; i++) {
        const [column, row, d] = place(x[i], y[i], z[i]);
        if (d < 0.5) continue;
        const size = Math.max(1, Math.min(5, Math.round(((0.045 * width) / d + 0.7) * Math.sqrt(ratio))));
        const left = Math.round(column - size / 2), top = Math.round(row - size / 2);
        if (left < 0 || top < 0 || left + size > width || top + size > height) continue;
        for (let v = top; v < top + size; v++) {
          for (let at = v * width + left; at < v * width + left + size; at++) {
            if (d < depth[at]) { depth[at] = d; out[at] = colours[i]; }
          }
        }
      }
      this.context.putImageData(picture, 0, 0);
    }

    lines(place, ratio) {
      const body = document.body.classList, shown = { truth: !body.contains("no-truth"), found: !body.contains("no-found"), other: !body.contains("no-found") };
      const colours = { truth: "#2bd4a4", found: "#ff8a3d", other: "#c48bff" }, leastOf = (name) => AugCloud.least[name] ?? -Infinity;
      for (const box of this.boxes) {
        if (!shown[box.kind] || (box.kind === "found" && box.score < leastOf(box.class))) continue;
        const corners = box.corners.map((corner) => place(...corner)), wrong = box.wrong || (box.met !== null && box.met < leastOf(box.class));
        this.context.strokeStyle = colours[box.kind];
        this.context.lineWidth = (wrong ? 2.6 : 1.5) * ratio;
        this.context.setLineDash(wrong ? [5 * ratio, 3 * ratio] : []);
        this.context.beginPath();
        for (const [a, b] of EDGES) {
          if (corners[a][2] < 0.5 || corners[b][2] < 0.5) continue;
          this.context.moveTo(corners[a][0], corners[a][1]);
          this.context.lineTo(corners[b][0], corners[b][1]);
        }
        this.context.stroke();
      }
      this.context.setLineDash([]);
    }

    turn(dx, dy) {
      this.yaw -= dx;
      this.pitch = Math.min(Math.max(this.pitch + dy, -0.3), 1.57);
      this.soon();
    }

    shift(dx, dy) {
      const { right, up } = this.axes(), step = this.distance;
      this.target = this.target.map((value, k) => value - step * (dx * right[k] - dy * up[k]));
      this.soon();
    }

    zoom(factor) {
      this.distance = Math.min(Math.max(this.distance * factor, 1), 250);
      this.soon();
    }

    listen() {
      const canvas = this.canvas, fingers = new Map();
      canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        fingers.set(event.pointerId, [event.clientX, event.clientY]);
        canvas.focus({ preventScroll: true });
      });
      const gone = (event) => fingers.delete(event.pointerId);
      canvas.addEventListener("pointerup", gone);
      canvas.addEventListener("pointercancel", gone);
      canvas.addEventListener("pointermove", (event) => { if (fingers.has(event.pointerId)) this.moved(event, fingers); });
      canvas.addEventListener("contextmenu", (event) => event.preventDefault());
      // The wheel scrolls the page until the cloud has been clicked.
      canvas.addEventListener("wheel", (event) => {
        if (document.activeElement !== canvas) return;
        event.preventDefault();
        this.zoom(Math.exp(event.deltaY * 0.0012));
      }, { passive: false });
      canvas.addEventListener("keydown", (event) => this.pressed(event));
      this.holder.querySelector("select.colouring").addEventListener("change", (event) => this.colour(event.target.value));
      for (const button of this.holder.querySelectorAll("button[data-look]")) button.addEventListener("click", () => this.look(button.dataset.look));
      if (window.ResizeObserver) new ResizeObserver(() => this.soon()).observe(canvas);
    }

    moved(event, fingers) {
      const old = fingers.get(event.pointerId), now = [event.clientX, event.clientY];
      const dx = (now[0] - old[0]) / this.canvas.clientWidth, dy = (now[1] - old[1]) / this.canvas.clientWidth;
      const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      fingers.set(event.pointerId, now);
      if (others.length) {
        const far = (at) => Math.hypot(at[0] - others[0][0], at[1] - others[0][1]);
        this.zoom(Math.max(far(old), 1) / Math.max(far(now), 1));
        this.shift(dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons === 2) this.shift(dx, dy);
      else this.turn(4 * dx, 4 * dy);
    }

    pressed(event) {
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      const names = this.cloud.colourings, all = [...Object.keys(names), "distance", "height"];
      const actions = {
        ArrowLeft: () => this.turn(0.08, 0), ArrowRight: () => this.turn(-0.08, 0), ArrowUp: () => this.turn(0, 0.06), ArrowDown: () => this.turn(0, -0.06),
        a: () => this.shift(0.04, 0), d: () => this.shift(-0.04, 0), w: () => this.shift(0, 0.04), s: () => this.shift(0, -0.04),
        "+": () => this.zoom(0.85), "=": () => this.zoom(0.85), "-": () => this.zoom(1.18), r: () => this.look("behind"), t: () => this.look("above"),
        c: () => this.colour(all[(all.indexOf(this.holder.dataset.colour) + 1) % all.length]),
      };
      if (!actions[event.key]) return;
      event.preventDefault();
      event.stopPropagation();
      actions[event.key]();
    }
  }

  const views = new Map();
  // A cloud is unpacked when it first comes near the screen; where that fails its still picture stays.
  const open = (holder) => {
    if (views.has(holder)) return views.get(holder);
    let view = null;
    try {
      holder.classList.add("live");
      view = new View(holder);
    } catch (error) {
      holder.classList.remove("live");
      holder.querySelector(".cloud-problem").textContent = `This browser cannot draw the cloud (${error.message}); the picture shows it from one side.`;
    }
    views.set(holder, view);
    return view;
  };
  const redraw = () => { for (const view of views.values()) if (view) view.soon(); };
  return { open, redraw, least: {} };
})();
