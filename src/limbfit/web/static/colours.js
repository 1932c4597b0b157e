// Colour maps that people with any colour-vision deficiency can read: viridis and cividis (both CC0), 33 stops.
const MAP_STOPS = {
  viridis:
    "440154 470d60 48186a 482374 472d7b 453781 424086 3e4989 3b528b 375b8d 33638d " +
    "2f6b8e 2c728e 297a8e 26828e 23898e 21918c 1f988b 1fa088 22a785 28ae80 32b67a " +
    "3fbc73 4ec36b 5ec962 70cf57 84d44b 98d83e addc30 c2df23 d8e219 ece51b fde725",
  cividis:
    "00224e 00285b 002e6a 053371 1a386f 273e6e 32436d 3b496c 434e6c 4b546c 535a6d " +
    "5a5f6e 61656f 686a71 6f7073 767676 7d7c78 848279 8c8878 938e78 9b9476 a39a74 " +
    "aba072 b4a76f bcae6c c4b468 cdbb63 d5c25e dec958 e7d150 f0d846 f9e03a fee838",
};

function stopsOf(name) {
  return MAP_STOPS[name].split(" ").map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
}

/** 256 colours as RGBA bytes. */
export function mapBytes(name) {
  const stops = stopsOf(name);
  const bytes = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const at = (i / 255) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    for (let k = 0; k < 3; k++) bytes[4 * i + k] = Math.round(stops[low][k] + (at - low) * (stops[low + 1][k] - stops[low][k]));
    bytes[4 * i + 3] = 255;
  }
  return bytes;
}

/** The map as a CSS gradient from left to right. */
export function mapGradient(name) {
  return `linear-gradient(to right, ${stopsOf(name).map((c) => `rgb(${c.join(" ")})`).join(", ")})`;
}

/** A number as people write it: about three digits, no exponent where it can be helped. */
export function shortNumber(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e5 || size < 1e-3)) return value.toExponential(2).replace("-", "−");
  const digits = size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : 3;
  return value.toFixed(size === 0 ? 0 : digits).replace("-", "−");
}
