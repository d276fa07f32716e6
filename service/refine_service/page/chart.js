// A chart of loss curves: one line each, logarithmic, with a key.

import { element, short } from "./dom.js";

const [WIDTH, HEIGHT] = [600, 180];
const SVG = "http://www.w3.org/2000/svg";

/** Replace what is in `place` by a chart of `curves`, {name: [numbers]}; those without a positive number are left out. */
export function drawChart(place, curves) {
  const lines = Object.entries(curves).filter(([, values]) => values.some((value) => value > 0));
  const positive = lines.flatMap(([, values]) => values.filter((value) => value > 0)).map(Math.log10);
  if (!positive.length) return;
  const high = Math.max(...positive);
  const low = Math.max(Math.min(...positive), high - 5); // five decades: below, nothing can be told apart
  const y = (value) => HEIGHT - 4 - ((Math.max(Math.log10(value), low) - low) / (high - low || 1)) * (HEIGHT - 8);
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("role", "img");
  const told = lines.map(([name, values]) => `${words(name)} from ${short(values[0])} to ${short(values.at(-1))}`);
  svg.setAttribute("aria-label", `Losses: ${told.join(", ")}`);
  const key = element("ul", { className: "key" });
  lines.forEach(([name, values], number) => {
    const line = document.createElementNS(SVG, "polyline");
    const points = values.map((value, i) => (value > 0 ? `${(i / Math.max(values.length - 1, 1)) * WIDTH},${y(value)}` : "")).filter(Boolean);
    line.setAttribute("points", points.join(" "));
    line.setAttribute("class", `line line-${number}`);
    svg.append(line);
    key.append(element("li", {}, element("i", { className: `swatch swatch-${number}` }), `${words(name)} ${short(values.at(-1))}`));
  });
  place.replaceChildren(svg, key);
}

const words = (name) => name.replaceAll("_", " ");
