// Which pixels of an image are the object: the rules of the engine (refine_engine/files/silhouette.py).

const BARELY_TRANSPARENT = 0.1, MOST_LABELS = 16, LABEL_REACH = 2;

/** The object, Uint8Array (H * W) of 0 and 1, in RGBA bytes {width, height, data}; null where all pixels have one level. */
export function objectOf({ width, height, data }, threshold) {
  const channel = deciding(data);
  const [low, high] = ends(channel);
  if (low === high) return null;
  if (hasTwo(channel)) return pixels(channel, (level) => level === high);
  const enough = low + threshold * (high - low);
  const labels = hasLabels(channel, width, height, low, enough);
  return pixels(channel, (level) => level > (labels ? low : enough));
}

/** Alpha, if it tells the object from the background, else the colours: a level for each pixel. */
function deciding(data) {
  const alpha = new Uint8Array(data.length / 4);
  for (let i = 0; i < alpha.length; i++) alpha[i] = data[4 * i + 3];
  const colour = colours(data);
  const [least, largest] = ends(alpha);
  const clear = pixels(alpha, (level) => 2 * level <= largest);
  const share = clear.reduce((sum, x) => sum + x, 0) / clear.length;
  if (least === largest || share === 0) return colour;
  if (share > BARELY_TRANSPARENT || !isMask(colour.filter((_, i) => !clear[i]))) return alpha;
  const [darkest] = ends(colour);
  return colour.map((level, i) => (clear[i] ? darkest : level));
}

/** The brightest of red, green and blue; where that tells nothing, luminance; of two that are alike, the colours themselves. */
function colours(data) {
  const count = data.length / 4;
  const [brightest, luminance, colour] = [0, 1, 2].map(() => new Int32Array(count));
  let grey = true;
  for (let i = 0; i < count; i++) {
    const [red, green, blue] = [data[4 * i], data[4 * i + 1], data[4 * i + 2]];
    brightest[i] = Math.max(red, green, blue);
    luminance[i] = 299 * red + 587 * green + 114 * blue;
    colour[i] = (red << 16) | (green << 8) | blue;
    grey &&= red === green && green === blue;
  }
  const same = (levels) => levels.every((level) => level === levels[0]);
  const two = hasTwo(colour);
  if (grey || (!two && !same(brightest))) return brightest;
  return two && same(luminance) ? colour : luminance;
}

function ends(levels) {
  let [low, high] = [Infinity, -Infinity];
  for (const level of levels) {
    if (level < low) low = level;
    if (level > high) high = level;
  }
  return [low, high];
}

function hasTwo(levels) {
  const other = levels.find((level) => level !== levels[0]);
  return other !== undefined && levels.every((level) => level === levels[0] || level === other);
}

/** Whether these are the levels of a mask: hardly any between the ends, and something at both. */
function isMask(levels) {
  const [low, high] = ends(levels);
  let dark = 0, bright = 0;
  for (const level of levels) {
    if (level - low < 0.1 * (high - low)) dark++;
    if (level - low > 0.9 * (high - low)) bright++;
  }
  return low < high && Math.min(dark, bright) > 0.001 * levels.length && dark + bright > 0.95 * levels.length;
}

/** Whether the picture has a few levels of which some below `enough` fill regions, and no more than soft edges. */
function hasLabels(channel, width, height, low, enough) {
  if (new Set(channel).size > MOST_LABELS) return false;
  let covers = 0, above = 0;
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const level = channel[y * width + x];
      if (level <= low) continue;
      above++;
      if (level <= enough && isFlat(channel, width, height, x, y)) covers++;
    }
  }
  return covers > 0.02 * above;
}

function isFlat(channel, width, height, x, y) {
  for (let v = Math.max(0, y - LABEL_REACH); v <= Math.min(height - 1, y + LABEL_REACH); v++) {
    for (let u = Math.max(0, x - LABEL_REACH); u <= Math.min(width - 1, x + LABEL_REACH); u++) {
      if (channel[v * width + u] !== channel[y * width + x]) return false;
    }
  }
  return true;
}

const pixels = (levels, isIn) => Uint8Array.from(levels, (level) => (isIn(level) ? 1 : 0));
