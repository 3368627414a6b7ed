// Reads what spslam/evaluation/web_data.py packs into the page.
const reportData = (() => {
  "use strict";

  // Inflates base64 of zlib's format.
  const inflate = async (text) => {
    const packed = Uint8Array.from(atob(text.trim()), (character) => character.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  };

  // Typed arrays by name.
  const arrays = async (packed) => {
    const types = { Uint8Array, Uint32Array, Float32Array };
    const buffer = await inflate(packed.data);
    const found = {};
    let offset = 0;
    for (const [name, type, length] of packed.arrays) {
      found[name] = new types[type](buffer, offset, length);
      offset += found[name].byteLength;
    }
    return found;
  };

  // 0, 1, 2, 3, ... were 0, -1, 1, -2, ...
  const signed = (code) => (code & 1 ? -(code + 1) / 2 : code / 2);

  // Positions [V, 3] in meters, colors [V, 3] in bytes, and corners of faces [F, 3].
  const mesh = async (packed) => {
    const { positions, colors, corners } = await arrays(packed);
    const [vertices, count] = [packed.vertices, 3 * packed.faces];
    const found = {
      positions: new Float32Array(3 * vertices),
      colors: new Uint8Array(3 * vertices),
      faces: new Uint32Array(count),
    };
    for (let axis = 0; axis < 3; axis++) {
      const plane = 2 * axis * vertices;
      let step = 0;
      let color = 0;
      for (let i = 0; i < vertices; i++) {
        step = (step + signed(positions[plane + i] | (positions[plane + vertices + i] << 8))) & 0xffff;
        color = (color + signed(colors[axis * vertices + i])) & 0xff;
        found.positions[3 * i + axis] = packed.origin[axis] + packed.step * step;
        found.colors[3 * i + axis] = color;
      }
    }
    let next = 0;
    for (let i = 0; i < count; i++) {
      const below = corners[i] | (corners[count + i] << 8) | (corners[2 * count + i] << 16);
      found.faces[i] = next - below;
      if (below === 0) next++;
    }
    return found;
  };

  return { inflate, arrays, mesh };
})();
