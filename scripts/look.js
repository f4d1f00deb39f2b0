// What is wrong with the page it runs in, and where its links lead; scripts/look.py reads the value.
(() => {
  const problems = [];
  const named = (e) => `${e.tagName.toLowerCase()}.${e.className}`;

  // Elements that reach beyond the window without lying in something that scrolls.
  const root = document.documentElement, edge = root.clientWidth + 1;
  const scrolls = (e) => {
    while ((e = e.parentElement) && e !== document.body) if (getComputedStyle(e).overflowX !== "visible") return true;
    return false;
  };
  const sticksOut = (e) => {
    const place = e.getBoundingClientRect();
    return place.width && place.right > edge && place.left < edge && e.checkVisibility() && !scrolls(e);
  };
  if (root.scrollWidth > edge) {
    const found = [...document.body.querySelectorAll("*")].filter(sticksOut).map(named);
    problems.push(`wider than the window: ${[...new Set(found)].slice(0, 4).join(", ")}`);
  }

  for (const image of document.images) {
    if (!image.checkVisibility()) continue;
    if (!image.naturalWidth) problems.push(`picture missing: ${image.src.slice(0, 90)}`);
    if (!image.hasAttribute("alt")) problems.push(`picture without alternative text: ${image.src.slice(0, 60)}`);
  }

  // Text with less contrast than WCAG AA asks: 4.5, large text 3. Colours are [r, g, b (0 to 255), alpha].
  const colour = (text) => {
    const values = text.match(/[\d.]+/g).map(Number), scale = text.startsWith("color(srgb") ? 255 : 1;
    return [...values.slice(0, 3).map((value) => scale * value), values[3] ?? 1];
  };
  const over = (top, below) => [0, 1, 2].map((i) => top[i] * top[3] + below[i] * (1 - top[3])).concat(1);
  const background = (e) => {
    const layers = [];
    for (; e; e = e.parentElement) {
      layers.push(colour(getComputedStyle(e).backgroundColor));
      if (layers.at(-1)[3] === 1) break;
    }
    return layers.reduceRight((below, layer) => over(layer, below), [255, 255, 255, 1]);
  };
  const linear = (value) => (value <= 0.03928 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
  const luminance = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const contrast = (e, style) => {
    const below = background(e), text = over(colour(style.color), below);
    const [light, dark] = [luminance(text), luminance(below)].sort((x, y) => y - x);
    return (light + 0.05) / (dark + 0.05);
  };
  const readable = (e) =>
    e.checkVisibility({ opacityProperty: true, visibilityProperty: true }) && !e.closest("svg, script, style, noscript");
  const told = new Set(), walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode()); ) {
    const e = node.parentElement, words = node.data.trim();
    if (!words || !readable(e) || e.getBoundingClientRect().width < 2) continue;
    const style = getComputedStyle(e), size = parseFloat(style.fontSize), ratio = contrast(e, style);
    const least = size >= 24 || (size >= 18.6 && style.fontWeight >= 700) ? 3 : 4.5;
    const text = `${named(e)} contrast ${ratio.toFixed(1)}`;
    if (ratio >= least || told.has(text)) continue;
    told.add(text);
    problems.push(`${text}: "${words.slice(0, 30)}"`);
  }

  const anchors = [...document.querySelectorAll("[id], a[name]")].flatMap((e) => [e.id, e.getAttribute("name")]);
  const links = [...document.querySelectorAll("a[href]")].map((a) => a.href);
  return { problems, links, anchors: anchors.filter(Boolean) };
})();
