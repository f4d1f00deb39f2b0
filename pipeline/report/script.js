"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  for (const kind of ["truth", "found"]) {
    const box = byId(`show-${kind}`);
    const apply = () => document.body.classList.toggle(`no-${kind}`, !box.checked);
    box.addEventListener("change", apply);
    apply();
  }

  // Scores are raw values of any scale: the slider runs over their ranks.
  const found = [...document.querySelectorAll(".box.found")];
  const scores = found.map((path) => Number(path.dataset.score)).sort((a, b) => a - b);
  const slider = byId("score");
  const applyScore = () => {
    const share = Number(slider.value) / 100;
    const least = share === 0 || !scores.length ? -Infinity : scores[Math.min(scores.length - 1, Math.floor(share * scores.length))];
    byId("score-text").textContent = least === -Infinity ? "all" : least.toFixed(2);
    for (const path of found) path.classList.toggle("low", Number(path.dataset.score) < least);
  };
  slider.addEventListener("input", applyScore);
  applyScore();

  const jump = byId("jump");
  if (jump) jump.addEventListener("change", () => byId(jump.value).scrollIntoView());

  const large = byId("large");
  for (const image of document.querySelectorAll("figure img")) {
    image.addEventListener("click", () => {
      large.querySelector("img").src = image.src;
      large.querySelector("img").alt = image.alt;
      large.querySelector("p").textContent = image.alt;
      large.showModal();
    });
  }
  large.addEventListener("click", () => large.close());
})();
