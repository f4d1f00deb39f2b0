// The page: switches, frames by key, values under the pointer, clouds when they come near.
(() => {
  const byId = (id) => document.getElementById(id);
  for (const kind of ["truth", "found"]) {
    const box = byId(`show-${kind}`);
    const apply = () => { document.body.classList.toggle(`no-${kind}`, !box.checked); AugCloud.redraw(); };
    box.addEventListener("change", apply);
    apply();
  }

  // Scores are raw values of any scale: the slider runs over their ranks.
  const found = [...document.querySelectorAll(".box.found, .box.other")];
  const scores = found.map((path) => Number(path.dataset.score)).sort((a, b) => a - b);
  // They start at the threshold of the detector's card. A label whose detection is not shown counts as missed.
  const slider = byId("score"), threshold = slider.dataset.least === undefined ? -Infinity : Number(slider.dataset.least);
  const labels = [...document.querySelectorAll(".box.truth[data-met]")];
  const applyScore = (least) => {
    byId("score-text").textContent = least === -Infinity ? "all" : least.toFixed(2);
    for (const path of found) path.classList.toggle("low", Number(path.dataset.score) < least);
    for (const path of labels) path.toggleAttribute("data-wrong", Number(path.dataset.met) < least);
    for (const frame of document.querySelectorAll("article")) tally(frame);
    AugCloud.least = least;
    AugCloud.redraw();
  };
  const tally = (frame) => {
    const view = frame.querySelector("svg.bev") || frame.querySelector("svg.photo"), text = frame.querySelector(".tally");
    if (!view || !text) return;
    const count = (kind) => view.querySelectorAll(`.box.${kind}`).length, shown = "found:not(.low)";
    const judged = view.querySelector("[data-met], [data-wrong]");
    text.textContent = `${count("truth")} true, ${count(shown)} predicted` + (judged
      ? `: ${count("truth[data-met]:not([data-wrong])")} found, ${count("truth[data-wrong]")} missed, ${count(`${shown}[data-wrong]`)} false` : "");
  };
  const slide = (value) => {
    slider.value = value;
    const share = Number(slider.value) / 100;
    applyScore(share === 0 || !scores.length ? -Infinity : scores[Math.min(scores.length - 1, Math.floor(share * scores.length))]);
  };
  const toThreshold = () => {
    slider.value = scores.length ? (100 * scores.filter((score) => score < threshold).length) / scores.length : 0;
    applyScore(threshold);
  };
  slider.addEventListener("input", () => slide(slider.value));
  toThreshold();

  // Frames: J and K (or N and P) go forward and back, the list jumps.
  const frames = [...document.querySelectorAll("article")], jump = byId("jump");
  const top = (frame) => frame.getBoundingClientRect().top;
  const current = () => frames.reduce((last, frame, i) => (top(frame) < 90 ? i : last), -1);
  const show = (i) => {
    const frame = frames[Math.min(Math.max(i, 0), frames.length - 1)];
    if (!frame) return;
    frame.scrollIntoView();
    history.replaceState(null, "", `#${frame.id}`);
    if (jump) jump.value = frame.id;
  };
  if (jump) {
    jump.addEventListener("change", () => show(frames.findIndex((frame) => frame.id === jump.value)));
    byId("next").addEventListener("click", () => show(current() + 1));
    byId("previous").addEventListener("click", () => show(current() - 1));
  }
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    const step = { j: 1, n: 1, k: -1, p: -1 }[event.key];
    if (step) show(current() + step);
    const boxes = { 1: "truth", 2: "found" }[event.key];
    if (boxes) byId(`show-${boxes}`).click();
    const change = { "[": -5, "]": 5 }[event.key];
    if (change) slide(Number(slider.value) + change);
    if (event.key === "0") { if (AugCloud.least === -Infinity) toThreshold(); else slide(0); }
    if (event.key === "?") help();
  });
  const help = () => {
    const keys = byId("keys");
    if (keys.open) keys.close();
    else if (keys.showModal) keys.showModal();
  };
  byId("help").addEventListener("click", help);

  // Values: pointing at one map of a frame reads all maps of that frame at the same place.
  const grids = new Map();
  const gridOf = (holder) => {
    if (!grids.has(holder)) {
      const raw = atob(holder.dataset.grid), values = new Uint16Array(raw.length / 2);
      for (let i = 0; i < values.length; i++) values[i] = raw.charCodeAt(2 * i) | (raw.charCodeAt(2 * i + 1) << 8);
      grids.set(holder, values);
    }
    return grids.get(holder);
  };
  const read = (holder, x, y) => {
    const { columns, rows, scale, unit } = holder.dataset;
    const column = Math.min(Math.floor(x * columns), columns - 1), row = Math.min(Math.floor(y * rows), rows - 1);
    const value = gridOf(holder)[row * columns + column];
    return value === 65535 ? "–" : `${(value / scale).toFixed(2)}${unit ? ` ${unit}` : ""}`;
  };
  const point = (frame, x, y) => {
    for (const holder of frame.querySelectorAll(".pointed")) {
      holder.style.setProperty("--x", `${100 * x}%`);
      holder.style.setProperty("--y", `${100 * y}%`);
      holder.closest("figure").querySelector("output").textContent = read(holder, x, y);
    }
    frame.classList.add("reading");
  };
  const pointer = (event) => {
    const area = event.target.closest && event.target.closest(".pointed, svg.photo");
    if (!area) return;
    const edge = area.getBoundingClientRect();
    const x = (event.clientX - edge.left) / edge.width, y = (event.clientY - edge.top) / edge.height;
    if (x >= 0 && x < 1 && y >= 0 && y < 1) point(area.closest("article"), x, y);
  };
  for (const frame of frames) {
    frame.addEventListener("pointermove", pointer);
    frame.addEventListener("pointerdown", pointer);
  }

  const large = byId("large");
  for (const image of document.querySelectorAll(".map img")) {
    image.addEventListener("click", () => {
      if (!large.showModal) return;
      large.querySelector("img").src = image.src;
      large.querySelector("img").alt = image.alt;
      large.querySelector("p").textContent = image.alt;
      large.showModal();
    });
  }
  large.addEventListener("click", () => large.close());

  const clouds = [...document.querySelectorAll(".cloud")];
  if (window.IntersectionObserver) {
    const near = new IntersectionObserver((entries) => {
      for (const entry of entries) if (entry.isIntersecting) { near.unobserve(entry.target); AugCloud.open(entry.target); }
    }, { rootMargin: "400px" });
    for (const cloud of clouds) near.observe(cloud);
  } else clouds.forEach(AugCloud.open);

  // #frame-3/noise opens a frame with its cloud coloured so: links into a report.
  const follow = () => {
    const [id, colour] = location.hash.slice(1).split("/");
    const frame = frames.find((item) => item.id === id);
    if (!frame || !colour) return;
    frame.scrollIntoView();
    const view = frame.querySelector(".cloud") && AugCloud.open(frame.querySelector(".cloud"));
    if (view && (view.cloud.colourings[colour] || ["distance", "height"].includes(colour))) view.colour(colour);
  };
  window.addEventListener("hashchange", follow);
  follow();
})();
