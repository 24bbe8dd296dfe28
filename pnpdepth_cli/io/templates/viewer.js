"use strict";
// The 3D view of a frame, drawn with three.js. report.js loads this file when a view is opened,
// then a file of the frame, which calls pnpdepthView with what view_3d.py wrote.

const pnpdepthViewer = (() => {
  const BACKGROUND = 0x1b1d21;
  const FOV_DEG = 50;
  const OVERLAP = 1.7; // points are so much larger than their spacing, so that surfaces close
  const shader = {
    vertexShader: `
      attribute vec3 rgb;
      uniform float scale;
      varying vec3 colour;
      void main() {
        vec4 seen = modelViewMatrix * vec4(position, 1.0);
        colour = rgb;
        gl_Position = projectionMatrix * seen;
        gl_PointSize = clamp(scale * position.z / seen.z, 1.0, 24.0);
      }`,
    fragmentShader: `
      varying vec3 colour;
      void main() { gl_FragColor = vec4(colour, 1.0); }`,
  };

  let renderer, scene, camera, controls, frame, points, waiting = false;

  const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;

  // Directions x/z, y/z of every pixel, interpolated between the nodes of a coarse grid.
  function directions({ size, whole, stride, rays }) {
    const [width, height] = size;
    const [columns, rows] = rays.size;
    const nodes = new Float32Array(bytesOf(rays.values));
    const result = new Float32Array(2 * width * height);
    for (let row = 0; row < height; row += 1) {
      const y = ((row * stride + (stride >> 1)) / (whole[1] - 1)) * (rows - 1);
      const top = Math.min(Math.floor(y), rows - 2);
      for (let column = 0; column < width; column += 1) {
        const x = ((column * stride + (stride >> 1)) / (whole[0] - 1)) * (columns - 1);
        const left = Math.min(Math.floor(x), columns - 2);
        for (let axis = 0; axis < 2; axis += 1) {
          const at = (r, c) => nodes[2 * (r * columns + c) + axis];
          const upper = at(top, left) + (x - left) * (at(top, left + 1) - at(top, left));
          const lower = at(top + 1, left) + (x - left) * (at(top + 1, left + 1) - at(top + 1, left));
          result[2 * (row * width + column) + axis] = upper + (y - top) * (lower - upper);
        }
      }
    }
    return result;
  }

  function unpacked(content) {
    const [near, far] = content.range;
    const colours = new Uint8Array(bytesOf(content.colours));
    const rays = directions(content);
    const clouds = {};
    for (const [name, text] of Object.entries(content.depths)) {
      const codes = new Uint16Array(bytesOf(text));
      const known = [];
      codes.forEach((code, i) => { if (code && rays[2 * i] === rays[2 * i]) known.push(i); });
      const xyz = new Float32Array(3 * known.length);
      const rgb = new Uint8Array(3 * known.length);
      known.forEach((i, n) => {
        const depth = near * (far / near) ** ((codes[i] - 1) / 65534);
        // three.js has y up and z towards the viewer
        xyz.set([depth * rays[2 * i], -depth * rays[2 * i + 1], -depth], 3 * n);
        rgb.set(colours.subarray(3 * i, 3 * i + 3), 3 * n);
      });
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(xyz, 3));
      geometry.setAttribute("rgb", new THREE.BufferAttribute(rgb, 3, true));
      clouds[name] = geometry;
    }
    return clouds;
  }

  function begin() {
    renderer = new THREE.WebGLRenderer({ antialias: true });
    renderer.setClearColor(BACKGROUND);
    scene = new THREE.Scene();
    camera = new THREE.PerspectiveCamera(FOV_DEG, 1);
    const material = new THREE.ShaderMaterial({ ...shader, uniforms: { scale: { value: 1 } } });
    points = new THREE.Points(new THREE.BufferGeometry(), material);
    points.frustumCulled = false;
    scene.add(points);
    controls = new THREE.OrbitControls(camera, renderer.domElement);
    controls.addEventListener("change", draw);
    new ResizeObserver(fit).observe(renderer.domElement);
    renderer.domElement.setAttribute("role", "img");
  }

  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; renderer.render(scene, camera); });
  }

  function fit() {
    const { clientWidth: width, clientHeight: height } = renderer.domElement;
    if (!frame || !width || !height) return;
    const ratio = Math.min(devicePixelRatio, 2);
    renderer.setPixelRatio(ratio);
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    const perTangent = (ratio * height) / (2 * Math.tan((FOV_DEG * Math.PI) / 360));
    points.material.uniforms.scale.value = OVERLAP * frame.spacing * perTangent;
    draw();
  }

  // Behind the camera that took the image and beside it, looking at the middle of the scene.
  function reset() {
    const { middle } = frame;
    camera.near = middle / 500;
    camera.far = frame.farthest * 20;
    camera.position.set(0.25 * middle, 0.2 * middle, 0.05 * middle);
    controls.target.set(0, 0, -middle);
    controls.update();
    fit();
  }

  function show(content) {
    if (!renderer) begin();
    clear();
    frame = { ...content, clouds: unpacked(content) };
    reset();
    return renderer.domElement;
  }

  function choose(name, label) {
    points.geometry = frame.clouds[name];
    const count = points.geometry.getAttribute("position").count;
    renderer.domElement.setAttribute("aria-label", `${label}: ${count.toLocaleString("en")} points`);
    draw();
    return count;
  }

  function clear() {
    for (const geometry of Object.values(frame ? frame.clouds : {})) geometry.dispose();
    frame = undefined;
  }

  return { show, choose, reset, clear };
})();
