// The one colour scale of values from 0 to 1: viridis, as the engine's files/colour_scale.py has it.

const VIRIDIS = `
  440154 470d60 48186a 482374 472d7b 453781 424086 3e4989 3b528b 375b8d 33638d
  2f6b8e 2c728e 297a8e 26828e 23898e 21918c 1f978b 1f9f88 21a685 27ad81 31b57b
  3dbc74 4cc26c 5cc863 6ece58 81d34d 95d840 aadc32 c0df25 d5e21a eae51a fde725`
  .trim().split(/\s+/).map((hex) => [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255));

/** sRGB [r, g, b] in [0, 1]; what is outside of 0 to 1 gets the colour of the end. */
export function colourOf(value) {
  const at = Math.min(Math.max(value, 0), 1) * (VIRIDIS.length - 1);
  const low = VIRIDIS[Math.floor(at)], high = VIRIDIS[Math.ceil(at)];
  return low.map((channel, i) => channel + (high[i] - channel) * (at % 1));
}

/** Draw the scale from left to right into a canvas. */
export function drawScale(canvas) {
  const context = canvas.getContext("2d");
  for (let x = 0; x < canvas.width; x++) {
    context.fillStyle = `rgb(${colourOf(x / (canvas.width - 1)).map((channel) => Math.round(channel * 255)).join(" ")})`;
    context.fillRect(x, 0, 1, canvas.height);
  }
}
