// The page: switches, frames by key, values under the pointer, clouds when they come near.
(() => {
  const byId = (id) => document.getElementById(id);
  for (const kind of ["truth", "found"]) {
    const box = byId(`show-${kind}`);
    if (!box) continue;
    const apply = () => { document.body.classList.toggle(`no-${kind}`, !box.checked); AugCloud.redraw(); };
    box.addEventListener("change", apply);
    apply();
  }

  // Scores are raw values of any scale, and every class has its own: the slider runs over the ranks within each class.
  // All classes start together at the thresholds of the detector's card, in the middle of the slider (without a card at
  // its left end, where everything is shown), and move together from there.
  const found = [...document.querySelectorAll(":is(.box, .name):is(.found, .other)")];
  const scores = {};
  for (const path of found) if (path.matches(".box")) (scores[path.dataset.class] ||= []).push(Number(path.dataset.score));
  for (const values of Object.values(scores)) values.sort((a, b) => a - b);
  const classes = Object.keys(scores).sort();
  const slider = byId("score"), thresholds = JSON.parse(slider.dataset.least || "{}");
  const start = slider.dataset.least ? 50 : 0;
  const leastOf = (name, place) => {
    const values = scores[name], threshold = name in thresholds ? thresholds[name] : -Infinity;
    if (place <= 0) return -Infinity;
    if (place === start) return threshold;
    const below = start ? values.filter((score) => score < threshold).length / values.length : 0;
    const share = place < start ? (below * place) / start : below + ((1 - below) * (place - start)) / (100 - start);
    return values[Math.min(values.length - 1, Math.floor(share * values.length))];
  };
  // A label whose detection is not shown counts as missed.
  const labels = [...document.querySelectorAll(".box.truth[data-met]")];
  const applyScore = (place) => {
    slider.value = place;
    const least = Object.fromEntries(classes.map((name) => [name, leastOf(name, Number(slider.value))]));
    const words = Object.entries(least).filter(([, score]) => Number.isFinite(score)).map(([name, score]) => `${name} ${score.toFixed(2)}`);
    byId("score-text").textContent = Number(slider.value) <= 0 ? "all" : words.join(", ") || "all";
    for (const path of found) path.classList.toggle("low", Number(path.dataset.score) < least[path.dataset.class]);
    for (const path of labels) path.toggleAttribute("data-wrong", Number(path.dataset.met) < (least[path.dataset.class] ?? -Infinity));
    for (const frame of document.querySelectorAll("article")) tally(frame);
    AugCloud.least = least;
    AugCloud.redraw();
  };
  const tally = (frame) => {
    const view = frame.querySelector("svg.bev") || frame.querySelector("svg.photo"), text = frame.querySelector(".tally");
    if (!view || !text) return;
    const count = (kind) => view.querySelectorAll(`.box.${kind}`).length, shown = "found:not(.low)";
    const counts = (total, what, kinds) => {
      const entries = Object.entries(kinds), rest = total - entries.reduce((sum, [, n]) => sum + n, 0);
      if (rest === total) return `${total} ${what}`;
      return `${total} ${what}: ${entries.map(([name, n]) => `${n} ${name}`).join(", ")}${rest ? `, ${rest} not counted` : ""}`;
    };
    const parts = [];
    if (frame.dataset.labelled) {
      parts.push(counts(count("truth"), "true", { found: count("truth[data-met]:not([data-wrong])"), missed: count("truth[data-wrong]") }));
    }
    if (/predicted/.test(text.textContent)) {
      parts.push(counts(count(shown), "predicted", { right: count(`${shown}[data-right]`), false: count(`${shown}[data-wrong]`) }));
    }
    text.textContent = parts.join("; ");
  };
  const slide = (place) => applyScore(Math.min(100, Math.max(0, place)));
  const toThreshold = () => slide(start);
  slider.addEventListener("input", () => slide(Number(slider.value)));
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
    if (boxes && byId(`show-${boxes}`)) byId(`show-${boxes}`).click();
    const change = { "[": -5, "]": 5 }[event.key];
    if (change) slide(Number(slider.value) + change);
    if (event.key === "0") { if (Number(slider.value) === 0) toThreshold(); else slide(0); }
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
