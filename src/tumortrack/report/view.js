"use strict";
// One scene in 3-D: surfaces, points and thick lines, by WebGL; orthographic, so that the scale bar
// holds at every depth. Camera frame, mm: x right, y down, z away.
const BAR_MM = 20, REM = parseFloat(getComputedStyle(document.documentElement).fontSize);
const FIRST_EYE = [-0.5, -0.55, -1.1]; // from the middle: before the organ, somewhat left and above

const SURFACE = `attribute vec3 place, normal; uniform mat3 turn; uniform vec3 middle, scale;
varying vec3 facing;
void main() { facing = turn * normal; gl_Position = vec4(scale * (turn * (place - middle)), 1.0); }`;
const SHADED = `precision mediump float; uniform vec4 colour; varying vec3 facing;
void main() {
  float light = abs(dot(normalize(facing), vec3(-0.36, 0.48, 0.8)));
  gl_FragColor = vec4(colour.rgb * (0.5 + 0.5 * light) + 0.12 * pow(light, 16.0), colour.a);
}`;
const POINT = `attribute vec3 place; uniform mat3 turn; uniform vec3 middle, scale; uniform float wide;
void main() { gl_Position = vec4(scale * (turn * (place - middle)), 1.0); gl_PointSize = wide; }`;
const ROUND = `precision mediump float; uniform vec4 colour;
void main() { if (length(gl_PointCoord - 0.5) > 0.5) discard; gl_FragColor = colour; }`;
// A line is two triangles as wide as asked on the screen: wider lines than 1 px are not drawn else.
const LINE = `attribute vec3 place, other; attribute float side; uniform mat3 turn;
uniform vec3 middle, scale; uniform vec2 pixel; uniform float wide;
void main() {
  vec3 here = scale * (turn * (place - middle)), there = scale * (turn * (other - middle));
  vec2 along = (there.xy - here.xy) / pixel;
  vec2 across = length(along) > 0.0 ? normalize(vec2(-along.y, along.x)) : vec2(0.0);
  gl_Position = vec4(here.xy + across * side * wide * pixel, here.z - 0.002, 1.0);
}`;
const PLAIN = "precision mediump float; uniform vec4 colour; void main() { gl_FragColor = colour; }";

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

function turnFrom(eye) { // rows: right, up and towards the eye
  const towards = unit(eye), right = unit(cross([0, -1, 0], towards));
  return [right, cross(towards, right), towards];
}
function turnedBy(rows, axis, angle) { // by Rodrigues' formula, about an axis of the screen
  const [c, s] = [Math.cos(angle), Math.sin(angle)], out = [[], [], []];
  for (let n = 0; n < 3; n++) {
    const column = rows.map((row) => row[n]), side = cross(axis, column), along = dot(axis, column);
    column.forEach((x, k) => (out[k][n] = x * c + side[k] * s + axis[k] * along * (1 - c)));
  }
  return out;
}
function normalsOf(places, faces) {
  const normals = new Float32Array(places.length);
  for (let n = 0; n < faces.length; n += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => places.subarray(3 * faces[n + k], 3 * faces[n + k] + 3));
    const normal = cross([0, 1, 2].map((k) => b[k] - a[k]), [0, 1, 2].map((k) => c[k] - a[k]));
    for (let k = 0; k < 9; k++) normals[3 * faces[n + Math.floor(k / 3)] + (k % 3)] += normal[k % 3];
  }
  return normals;
}
const rgb = (css) => [1, 3, 5].map((n) => parseInt(css.slice(n, n + 2), 16) / 255);

class SceneView {
  constructor(host) {
    host.innerHTML = "<canvas></canvas><div class='legend'></div><div class='scalebar'></div>";
    [this.canvas, this.legend, this.bar] = host.children;
    this.hidden = new Set();
    this.gl = this.canvas.getContext("webgl", { antialias: true });
    if (!this.gl || !this.gl.getExtension("OES_element_index_uint")) {
      host.innerHTML = "<p class='nothing'>This browser shows no WebGL, so there is no 3-D view. " +
        "The views and slices below show the same scene.</p>";
      this.gl = null;
      return;
    }
    this.programs = { surface: this.program(SURFACE, SHADED), points: this.program(POINT, ROUND),
                      outline: this.program(LINE, PLAIN) };
    this.reset();
    const held = new Map();
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    this.canvas.addEventListener("pointermove", (event) => this.moved(event, held));
    for (const end of ["pointerup", "pointercancel"]) {
      this.canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    }
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY / 500));
    }, { passive: false });
    this.canvas.addEventListener("dblclick", () => { this.reset(); this.draw(); });
    new ResizeObserver(() => this.draw()).observe(host);
  }

  reset() { this.turn = turnFrom(FIRST_EYE); this.zoom = 1; }
  zoomBy(times) { this.zoom = Math.min(20, Math.max(0.2, this.zoom * times)); this.draw(); }

  moved(event, held) { // one pointer turns, two zoom
    const before = held.get(event.pointerId), now = [event.clientX, event.clientY];
    if (!before) return;
    const others = [...held].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    held.set(event.pointerId, now);
    if (others.length) {
      const far = (place) => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]);
      this.zoomBy(far(now) / Math.max(1, far(before)));
      return;
    }
    const [x, y] = [now[0] - before[0], now[1] - before[1]];
    this.turn = turnedBy(turnedBy(this.turn, [0, 1, 0], x / 150), [1, 0, 0], y / 150);
    this.draw();
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return program;
  }

  buffer(content, target = this.gl.ARRAY_BUFFER) {
    const buffer = this.gl.createBuffer();
    this.made.push(buffer);
    this.gl.bindBuffer(target, buffer);
    this.gl.bufferData(target, content, this.gl.STATIC_DRAW);
    return buffer;
  }

  // layers: {kind, name, color, tumor, v: places, f: faces}, in base64; box: [lower, upper].
  show(layers, [lower, upper]) {
    if (!this.gl) return;
    (this.made || []).forEach((buffer) => this.gl.deleteBuffer(buffer));
    this.made = [];
    this.middle = lower.map((x, n) => (x + upper[n]) / 2);
    this.radius = Math.hypot(...upper.map((x, n) => x - lower[n])) / 2;
    this.parts = layers.map((layer) => this.part(layer));
    this.legend.replaceChildren(...this.parts.map((part) => this.entry(part)));
    this.draw();
  }

  part(layer) {
    const places = new Float32Array(bytes(layer.v)), surface = layer.kind === "surface";
    const part = { name: layer.name, kind: layer.kind, colour: rgb(layer.color || "#ffffff"),
                   opacity: surface ? (layer.tumor ? 0.9 : 0.42) : 1, buffers: {} };
    if (layer.kind === "outline" && !layer.tumor && !this.told) this.hidden.add(layer.name);
    if (layer.kind === "outline") this.lines(part, places);
    else part.buffers.place = [this.buffer(places), 3];
    part.count = part.count || places.length / 3;
    if (surface) {
      const faces = new Uint32Array(bytes(layer.f));
      part.buffers.normal = [this.buffer(normalsOf(places, faces)), 3];
      part.faces = this.buffer(faces, this.gl.ELEMENT_ARRAY_BUFFER);
      part.count = faces.length;
    }
    return part;
  }

  lines(part, places) { // four corners and two triangles for each pair of places
    const count = places.length / 6, ends = [0, 0, 1, 1], sides = [1, -1, -1, 1];
    const [here, there] = [new Float32Array(12 * count), new Float32Array(12 * count)];
    const side = new Float32Array(4 * count), faces = new Uint32Array(6 * count);
    for (let n = 0; n < count; n++) {
      ends.forEach((end, k) => {
        here.set(places.subarray(6 * n + 3 * end, 6 * n + 3 * end + 3), 12 * n + 3 * k);
        there.set(places.subarray(6 * n + 3 - 3 * end, 6 * n + 6 - 3 * end), 12 * n + 3 * k);
        side[4 * n + k] = sides[k];
      });
      faces.set([0, 1, 2, 0, 2, 3].map((k) => 4 * n + k), 6 * n);
    }
    part.buffers = { place: [this.buffer(here), 3], other: [this.buffer(there), 3], side: [this.buffer(side), 1] };
    part.faces = this.buffer(faces, this.gl.ELEMENT_ARRAY_BUFFER);
    part.count = faces.length;
  }

  entry(part) {
    const button = document.createElement("button"), swatch = document.createElement("i");
    swatch.style.background = `rgb(${part.colour.map((x) => 255 * x)})`;
    button.append(swatch, part.name);
    button.setAttribute("aria-pressed", !this.hidden.has(part.name));
    button.addEventListener("click", () => {
      this.told = true; // from then on a person says what is hidden, in all scenes
      if (!this.hidden.delete(part.name)) this.hidden.add(part.name);
      button.setAttribute("aria-pressed", !this.hidden.has(part.name));
      this.draw();
    });
    return button;
  }

  draw() {
    if (!this.gl || !this.parts) return;
    const gl = this.gl, ratio = window.devicePixelRatio || 1;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    if (!width || !height) return;
    [this.canvas.width, this.canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0x16 / 255, 0x18 / 255, 0x1d / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const perMm = (this.zoom * 0.75 * Math.min(width, height)) / this.radius; // pixels of the page
    this.scale = [(2 * perMm) / width, (2 * perMm) / height, -1 / (4 * this.radius)];
    this.bar.textContent = `${BAR_MM} mm`;
    this.bar.style.width = `${BAR_MM * perMm}px`;
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const shown = this.parts.filter((part) => !this.hidden.has(part.name));
    // What is solid first; then what shines through, its far side before its near one.
    for (const part of shown.filter((one) => one.opacity > 0.5)) this.drawPart(part, ratio);
    gl.depthMask(false);
    gl.enable(gl.CULL_FACE);
    for (const side of [gl.FRONT, gl.BACK]) {
      gl.cullFace(side);
      for (const part of shown.filter((one) => one.opacity <= 0.5)) this.drawPart(part, ratio);
    }
    gl.disable(gl.CULL_FACE);
    gl.depthMask(true);
  }

  drawPart(part, ratio) {
    const gl = this.gl, program = this.programs[part.kind];
    const uniform = (name) => gl.getUniformLocation(program, name);
    gl.useProgram(program);
    const [a, b, c] = this.turn; // WebGL takes columns
    gl.uniformMatrix3fv(uniform("turn"), false, [0, 1, 2].flatMap((n) => [a[n], b[n], c[n]]));
    gl.uniform3fv(uniform("middle"), this.middle);
    gl.uniform3fv(uniform("scale"), this.scale);
    gl.uniform4fv(uniform("colour"), [...part.colour, part.opacity]);
    gl.uniform1f(uniform("wide"), (part.kind === "points" ? REM / 5 : REM / 10) * ratio);
    gl.uniform2f(uniform("pixel"), 2 / this.canvas.width, 2 / this.canvas.height);
    for (const [name, [buffer, size]] of Object.entries(part.buffers)) {
      const at = gl.getAttribLocation(program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, gl.FLOAT, false, 0, 0);
    }
    if (!part.faces) return gl.drawArrays(gl.POINTS, 0, part.count);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, part.faces);
    return gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_INT, 0);
  }
}
