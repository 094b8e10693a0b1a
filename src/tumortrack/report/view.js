"use strict";
// The 3-D view of a scene: orthographic, in the camera's frame (mm; x right, y down, z away).
// `makeView(place)` fills that element; `show(layers, box)` of what it returns draws a scene.

const VIEW_BAR_MM = [20, 10, 5, 2, 1];  // the first that takes a third of the width at most
const VIEW_GROUND = [22 / 255, 24 / 255, 29 / 255];
const VIEW_MISSING = "This browser offers no WebGL 2, so the 3-D view is missing here; " +
  "everything else on this page is complete.";

const VIEW_PLACE = `#version 300 es
precision highp float;
uniform mat3 turn; uniform vec3 center, scale, shift; uniform vec2 pixel; uniform float size;
vec4 place(vec3 p) { return vec4(turn * (p - center) * scale + shift, 1); }`;
const VIEW_MESH = [VIEW_PLACE + `
in vec3 a, b; out vec3 normal;
void main() { gl_Position = place(a); normal = turn * b; }`, `#version 300 es
precision highp float;
uniform vec4 color; in vec3 normal; out vec4 seen;
void main() {
  vec3 n = normalize(normal) * (gl_FrontFacing ? 1.0 : -1.0);  // z: away from who looks
  float lit = 0.74 + 0.34 * max(dot(n, vec3(-0.36, 0.62, -0.70)), 0.0);
  float shine = 0.12 * pow(max(dot(n, vec3(-0.20, 0.34, -0.92)), 0.0), 24.0);
  float rim = 1.0 - abs(n.z);  // a thin shell looks denser where it is seen edge-on
  seen = vec4(color.rgb * lit + shine, mix(color.a, 1.0, 0.4 * rim * rim * rim));
}`];
const VIEW_PLAIN = `#version 300 es
precision mediump float;
uniform vec4 color; out vec4 seen;
void main() { seen = color; }`;
const VIEW_POINTS = [VIEW_PLACE + `
in vec3 a;
void main() { gl_Position = place(a); gl_PointSize = size; }`, VIEW_PLAIN];
// A line is a strip of two triangles, `size` pixels wide, as WebGL's own lines are one pixel thin;
// it is longer by half of that at both ends, so that the lines of a curve join.
const VIEW_LINES = [VIEW_PLACE + `
in vec3 a, b;
void main() {
  vec4 here = place(a), there = place(b);
  vec2 along = (there.xy - here.xy) / pixel;
  along = dot(along, along) > 1e-6 ? normalize(along) : vec2(1, 0);
  float end = float(gl_VertexID & 1) * 2.0 - 1.0, side = float(gl_VertexID >> 1) * 2.0 - 1.0;
  gl_Position = end < 0.0 ? here : there;
  gl_Position.xy += 0.5 * size * pixel * (end * along + side * vec2(-along.y, along.x));
}`, VIEW_PLAIN];

function viewBytes(text) {
  return Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
}
function viewCross(p, q) {
  return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
}
/** Of each vertex: the sum of its triangles' normals, so that large ones count more. */
function viewNormals(v, f) {
  const normals = new Float32Array(v.length);
  for (let n = 0; n < f.length; n += 3) {
    const [i, j, k] = [3 * f[n], 3 * f[n + 1], 3 * f[n + 2]];
    const side = (end) => [0, 1, 2].map((x) => v[end + x] - v[i + x]);
    viewCross(side(j), side(k)).forEach((area, x) => {
      for (const corner of [i, j, k]) normals[corner + x] += area;
    });
  }
  return normals;
}
/** Right, up and forward of a viewer at (-0.5, -0.55, -1.1), with -y up. */
function viewStart() {
  const away = [0.5, 0.55, 1.1], right = [1.1, 0, -0.5], up = viewCross(right, away);
  const unit = (v) => v.map((x) => x / Math.hypot(...v));
  return [right, up, away].map(unit);
}

function makeView(place) {
  place.innerHTML = `<div class="stage"><canvas tabindex="0" role="img"
    aria-label="3-D view; arrow keys turn it, plus and minus zoom"></canvas>
    <div class="mm"></div></div>
    <div class="legend" role="group" aria-label="parts shown"></div>`;
  const parted = ["canvas", ".mm", ".legend"].map((what) => place.querySelector(what));
  const [canvas, bar, legend] = parted;
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: true });
  if (!gl) {
    place.innerHTML = `<p class="missing">${VIEW_MISSING}</p>`;
    return { show() {} };
  }
  const shown = {}, touches = new Map();  // by name: whether shown; by pointer: where it is
  let programs, parts = [], scene, turn, zoom, shift, waiting = false;

  function program([vertex, fragment]) {
    const made = gl.createProgram();
    [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(([kind, text]) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    });
    ["a", "b"].forEach((name, n) => gl.bindAttribLocation(made, n, name));
    gl.linkProgram(made);
    return made;
  }
  function buffer(kind, content) {
    const made = gl.createBuffer();
    gl.bindBuffer(kind, made);
    gl.bufferData(kind, content, gl.STATIC_DRAW);
    return made;
  }
  function attribute(n, stride, offset, each) {  // from the buffer that is bound
    gl.enableVertexAttribArray(n);
    gl.vertexAttribPointer(n, 3, gl.FLOAT, false, stride, offset);
    gl.vertexAttribDivisor(n, each);
  }
  function part(layer) {
    const v = new Float32Array(viewBytes(layer.v)), color = layer.color || "#ffffff";
    const rgb = color.match(/\w\w/g).map((c) => parseInt(c, 16) / 255);
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffers = [buffer(gl.ARRAY_BUFFER, v)], made = { layer, color, rgb, array, buffers };
    if (layer.kind === "outline") {
      attribute(0, 24, 0, 1);
      attribute(1, 24, 12, 1);
      return { ...made, count: v.length / 6 };
    }
    attribute(0, 0, 0, 0);
    if (layer.kind === "points") return { ...made, count: v.length / 3 };
    const f = new Uint32Array(viewBytes(layer.f));
    buffers.push(buffer(gl.ARRAY_BUFFER, viewNormals(v, f)));
    attribute(1, 0, 0, 0);
    buffers.push(buffer(gl.ELEMENT_ARRAY_BUFFER, f));
    return { ...made, count: f.length };
  }

  function draw() {
    waiting = false;
    if (gl.isContextLost() || !scene) return;
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const wide = canvas.clientWidth, high = canvas.clientHeight, dense = window.devicePixelRatio;
    const size = [wide, high].map((side) => Math.max(1, Math.round(side * dense)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    gl.viewport(0, 0, ...size);
    gl.clearColor(...VIEW_GROUND, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const mm = perMm(), center = [0, 1, 2].map((n) => (scene.box[0][n] + scene.box[1][n]) / 2);
    const deep = Math.hypot(...[0, 1, 2].map((n) => scene.box[1][n] - scene.box[0][n]));
    const set = (made, name) => gl.getUniformLocation(made, name);
    for (const made of Object.values(programs)) {
      gl.useProgram(made);
      gl.uniformMatrix3fv(set(made, "turn"), true, turn.flat());
      gl.uniform3f(set(made, "center"), ...center);
      gl.uniform3f(set(made, "scale"), (2 * mm) / wide, (2 * mm) / high, 1 / deep);
      gl.uniform2f(set(made, "pixel"), 2 / size[0], 2 / size[1]);
      gl.uniform1f(set(made, "size"), Math.max(1.5, (rem / 7) * dense));
    }
    // `lift`: mm nearer than they are: lines and points show on the surface that they lie on, and
    // a tumor through the organ's thin rim upon it, without speckles.
    const paint = (which, alpha, lift) => parts.forEach(({ layer, rgb, array, count }) => {
      if (!shown[layer.name] || !which(layer)) return;
      const made = programs[layer.kind];
      gl.useProgram(made);
      gl.uniform4f(set(made, "color"), ...rgb, alpha);
      gl.uniform3f(set(made, "shift"), (2 * shift[0]) / wide, (-2 * shift[1]) / high, -lift / deep);
      gl.bindVertexArray(array);
      if (layer.kind === "surface") gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
      else if (layer.kind === "points") gl.drawArrays(gl.POINTS, 0, count);
      else gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    });
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.BLEND);
    gl.disable(gl.CULL_FACE);
    paint((layer) => layer.kind !== "surface", 1, 3);
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.cullFace(gl.BACK);
    paint((layer) => layer.kind === "surface" && layer.tumor, 0.85, 1.5);
    gl.depthMask(false);  // what is translucent hides nothing: first its far side
    for (const [hidden, alpha] of [[gl.FRONT, 0.45], [gl.BACK, 0.3]]) {
      gl.cullFace(hidden);
      paint((layer) => layer.kind === "surface" && !layer.tumor, alpha, 0);
    }
    const length = VIEW_BAR_MM.find((one) => one * mm < wide / 3) || VIEW_BAR_MM.at(-1);
    bar.style.width = `${length * mm}px`;
    bar.textContent = `${length} mm`;
  }
  function redraw() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }
  /** Pixels (of CSS) a mm: at zoom 1 the box as seen first, without its empty corners. */
  function perMm() {
    const sides = [0, 1, 2].map((n) => scene.box[1][n] - scene.box[0][n]);
    const extent = (row) => row.reduce((sum, r, n) => sum + Math.abs(r) * sides[n], 0);
    const [x, y] = viewStart().map(extent);
    return zoom * 1.25 * Math.min(canvas.clientWidth / x, canvas.clientHeight / y);
  }
  function reset() {
    [turn, zoom, shift] = [viewStart(), 1, [0, 0]];
    redraw();
  }
  function spin(x, y) {  // pixels: what is near follows the pointer
    const mix = (p, q, angle) => {
      const c = Math.cos(angle), s = Math.sin(angle), [a, b] = [turn[p], turn[q]];
      turn[p] = a.map((one, n) => c * one - s * b[n]);
      turn[q] = a.map((one, n) => s * one + c * b[n]);
    };
    mix(0, 2, x / 150);
    mix(1, 2, -y / 150);
    redraw();
  }
  function enlarge(by, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {  // about (x, y)
    const old = zoom, from = [x - canvas.clientWidth / 2, y - canvas.clientHeight / 2];
    zoom = Math.min(20, Math.max(0.3, zoom * by));
    shift = shift.map((one, n) => from[n] - ((from[n] - one) * zoom) / old);
    redraw();
  }
  function moved(event) {
    const before = touches.get(event.pointerId), now = [event.offsetX, event.offsetY];
    if (!before) return;
    touches.set(event.pointerId, now);
    const [x, y] = now.map((one, n) => one - before[n]);
    const other = [...touches].find(([id]) => id !== event.pointerId);
    if (!other) return spin(x, y);
    const far = (from) => Math.max(1, Math.hypot(from[0] - other[1][0], from[1] - other[1][1]));
    shift = [shift[0] + x / 2, shift[1] + y / 2];  // two fingers: moved and pinched
    enlarge(far(now) / far(before), ...now.map((one, n) => (one + other[1][n]) / 2));
  }
  function entry({ layer, color }) {
    const button = document.createElement("button"), swatch = document.createElement("i");
    swatch.className = layer.kind;
    swatch.style.color = color;
    button.append(swatch, layer.name);
    button.setAttribute("aria-pressed", shown[layer.name]);
    button.addEventListener("click", () => {
      shown[layer.name] = !shown[layer.name];
      button.setAttribute("aria-pressed", shown[layer.name]);
      redraw();
    });
    return button;
  }
  function load() {
    const kinds = { surface: VIEW_MESH, points: VIEW_POINTS, outline: VIEW_LINES };
    programs = {};
    for (const kind in kinds) programs[kind] = program(kinds[kind]);
  }
  function show(layers, box) {
    parts.forEach(({ array, buffers }) => {
      gl.deleteVertexArray(array);
      buffers.forEach((one) => gl.deleteBuffer(one));
    });
    scene = { layers, box };
    layers.forEach((layer) => { shown[layer.name] ??= layer.kind !== "outline" || layer.tumor; });
    parts = layers.map(part);
    legend.replaceChildren(...parts.map(entry));
    redraw();
  }
  const keys = { ArrowLeft: [-15, 0], ArrowRight: [15, 0], ArrowUp: [0, -15], ArrowDown: [0, 15] };
  const listen = (name, what) => canvas.addEventListener(name, what, { passive: false });
  listen("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    touches.set(event.pointerId, [event.offsetX, event.offsetY]);
  });
  listen("pointermove", moved);
  for (const name of ["pointerup", "pointercancel"]) {
    listen(name, (event) => touches.delete(event.pointerId));
  }
  listen("wheel", (event) => {
    event.preventDefault();
    const step = event.deltaMode === 1 ? 0.04 : 0.0015;  // of a line, of a pixel
    enlarge(Math.exp(-step * event.deltaY), event.offsetX, event.offsetY);
  });
  listen("dblclick", reset);
  listen("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;  // the browser's own
    if (event.key in keys) spin(...keys[event.key]);
    else if ("+=-".includes(event.key)) enlarge(event.key === "-" ? 0.87 : 1.15);
    else return;
    event.preventDefault();
  });
  listen("webglcontextlost", (event) => event.preventDefault());
  listen("webglcontextrestored", () => {
    load();
    if (scene) show(scene.layers, scene.box);
  });
  new ResizeObserver(redraw).observe(canvas);
  window.addEventListener("resize", redraw);  // also where only the density of pixels changed
  load();
  reset();
  return { show };
}
