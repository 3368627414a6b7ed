// What the 3-D view shows, as three.js objects: mesh, path, lost stretches, ground truth, cameras, and this frame's.
const reportScene = (() => {
  "use strict";

  const BLUE = [31, 111, 235];
  const AMBER = [245, 158, 11];
  const RED = [209, 36, 47];
  // Distance between two cameras that are drawn in their sizes, and the most of them.
  const SPACING = 3;
  const CAMERAS = 400;

  const mix = (from, to, share) => from.map((value, i) => (value + (to[i] - value) * share) / 255);

  // Blue below a probability of 1e-4 that the pose is wrong, amber at 1e-2, red at 1.
  const colorOf = (probability) => {
    const share = Math.min(Math.max((Math.log10(Math.max(probability || 0, 1e-9)) + 4) / 2, 0), 2);
    return share < 1 ? mix(BLUE, AMBER, share) : mix(AMBER, RED, share - 1);
  };

  // Lines of a width in px; WebGL's own are 1 px wide. `colors` has one per end of a segment, or there is one for all.
  const lines = (THREE, segments, { color, colors, width, opacity = 1 }) => {
    const geometry = new THREE.LineSegmentsGeometry();
    geometry.setPositions(new Float32Array(segments.length ? segments : [0, 0, 0, 0, 0, 0]));
    if (colors) geometry.setColors(new Float32Array(colors));
    const options = { linewidth: width, vertexColors: Boolean(colors), transparent: opacity < 1, opacity };
    const material = new THREE.LineMaterial(colors ? options : { ...options, color });
    return new THREE.LineSegments2(geometry, material);
  };

  const meshOf = (THREE, mesh) => {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(mesh.positions, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(mesh.colors, 3, true));
    geometry.setIndex(new THREE.BufferAttribute(mesh.faces, 1));
    geometry.computeVertexNormals();
    return new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.FrontSide }));
  };

  // Segments of a camera's view pyramid in its own axes (x right, y down, z forward), with a mark at its upper side.
  const pyramid = (camera, depth) => {
    const corner = (u, v) => [((u - camera.cx) / camera.fx) * depth, ((v - camera.cy) / camera.fy) * depth, depth];
    const { width, height } = camera;
    const rim = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
    const tip = corner(width / 2, -height / 5);
    const ends = rim.flatMap((at, i) => [[0, 0, 0], at, at, rim[(i + 1) % 4]]);
    return [...ends, rim[0], tip, tip, rim[1]].flat();
  };

  class Poses {
    constructor(THREE, arrays) {
      this.THREE = THREE;
      this.arrays = arrays;
      this.count = arrays.rows.length;
    }

    position(row) {
      return new this.THREE.Vector3().fromArray(this.arrays.positions, 3 * row);
    }

    // The page's are (w, x, y, z).
    rotation(row) {
      const [w, x, y, z] = this.arrays.quaternions.subarray(4 * row, 4 * row + 4);
      return new this.THREE.Quaternion(x, y, z, w);
    }

    matrix(row) {
      return new this.THREE.Matrix4().compose(this.position(row), this.rotation(row), new this.THREE.Vector3(1, 1, 1));
    }
  }

  // Segments between neighbors that `wanted` names, of points [N, 3].
  const joined = (points, count, wanted) => {
    const [segments, rows] = [[], []];
    for (let row = 0; row + 1 < count; row++) {
      if (!wanted(row)) continue;
      segments.push(...points.subarray(3 * row, 3 * row + 6));
      rows.push(row, row + 1);
    }
    return { segments, rows };
  };

  const pathOf = (THREE, poses) => {
    const { positions, lost, probability } = poses.arrays;
    const { segments, rows } = joined(positions, poses.count, (row) => !lost[row] && !lost[row + 1]);
    const colors = rows.flatMap((row) => (probability ? colorOf(probability[row]) : colorOf(0)));
    return lines(THREE, segments, { colors, width: 4 });
  };

  // From where tracking was lost straight to where it was found again, and a cross where it was lost.
  const lostOf = (THREE, poses, size) => {
    const { positions, lost } = poses.arrays;
    const { segments } = joined(positions, poses.count, (row) => lost[row] || lost[row + 1]);
    for (let row = 0; row < poses.count; row++) {
      if (!lost[row] || (row > 0 && lost[row - 1])) continue;
      const at = [...positions.subarray(3 * row, 3 * row + 3)];
      for (let axis = 0; axis < 3; axis++) {
        for (const sign of [-1, 1]) segments.push(...at.map((value, i) => value + (i === axis ? sign * size : 0)));
      }
    }
    return lines(THREE, segments, { color: 0xd1242f, width: 3 });
  };

  const truthOf = (THREE, poses) => {
    const truth = poses.arrays.truth;
    const known = (row) => Number.isFinite(truth[3 * row]) && Number.isFinite(truth[3 * row + 3]);
    return lines(THREE, joined(truth, poses.count, known).segments, { color: 0x8a939e, width: 2 });
  };

  // Cameras along the path, each a few of its own sizes or a quarter turn from the one before.
  const camerasOf = (THREE, poses, local, size) => {
    const segments = [];
    let [last, left] = [-1, CAMERAS];
    for (let row = 0; row < poses.count && left; row++) {
      if (poses.arrays.lost[row]) continue;
      const apart = last < 0 || poses.position(row).distanceTo(poses.position(last)) > SPACING * size;
      if (!apart && poses.rotation(row).angleTo(poses.rotation(last)) < Math.PI / 4) continue;
      [last, left] = [row, left - 1];
      const pose = poses.matrix(row);
      for (let k = 0; k < local.length; k += 3) {
        segments.push(...new THREE.Vector3().fromArray(local, k).applyMatrix4(pose));
      }
    }
    return lines(THREE, segments, { color: 0x5aa1f2, width: 1.2, opacity: 0.8 });
  };

  // The scene, its layers by name, and a function that moves this frame's camera.
  const build = (THREE, data, arrays, mesh) => {
    const scene = new THREE.Scene();
    const poses = new Poses(THREE, arrays);
    const size = Math.min(Math.max(0.05 * data.radius, 0.02), 0.25);
    const current = new THREE.Group();
    current.add(lines(THREE, pyramid(data.camera, 1.8 * size), { color: 0xf59e0b, width: 4 }));
    const layers = {
      path: pathOf(THREE, poses),
      lost: lostOf(THREE, poses, size / 2),
      frustums: camerasOf(THREE, poses, pyramid(data.camera, size), size),
      current,
    };
    if (arrays.truth) layers.truth = truthOf(THREE, poses);
    if (mesh) layers.mesh = meshOf(THREE, mesh);
    scene.add(...Object.values(layers));
    scene.add(new THREE.AmbientLight(0xffffff, 0.6 * Math.PI));
    const setRow = (row) => {
      current.position.copy(poses.position(row));
      current.quaternion.copy(poses.rotation(row));
    };
    return { scene, layers, poses, setRow };
  };

  return { build };
})();
