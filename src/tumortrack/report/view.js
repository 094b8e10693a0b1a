"use strict";
// The page of an evaluation: a 3-D view of each scene by three.js (vendored/three.min.js), in the
// camera's frame (mm; x right, y down, z away), without perspective.

const BAR_MM = [20, 10, 5, 2, 1];  // the first that takes a third of the width at most
// How much nearer to the viewer than it is: points and lines show on the surface that they lie on,
// and a tumor through the organ's thin rim upon it.
const LIFT_MM = { points: 3, outline: 3, tumor: 1.5 };
const $ = (id) => document.getElementById(id);

function bytes(text) {
  return Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
}

function translucent(geometry, color) {
  // First its depth alone: of each pixel the nearest skin is blended, and none behind it, so that
  // no triangle shows through another, whatever their order.
  const depth = new THREE.MeshBasicMaterial({ colorWrite: false, transparent: true });
  const skin = new THREE.MeshPhongMaterial({ color, transparent: true, opacity: 0.5 });
  skin.onBeforeCompile = (shader) => {  // a thin shell looks denser where it is seen edge-on
    shader.fragmentShader = shader.fragmentShader.replace("#include <opaque_fragment>", `
      diffuseColor.a = mix(diffuseColor.a, 1.0, 0.5 * pow(1.0 - abs(normal.z), 3.0));
      #include <opaque_fragment>`);
  };
  const meshes = [depth, skin].map((material) => new THREE.Mesh(geometry, material));
  meshes.forEach((mesh, n) => { mesh.renderOrder = n + 1; });
  return meshes;
}

function drawn(layer, pixel) {
  const v = new Float32Array(bytes(layer.v)), color = layer.color || "#ffffff";
  if (layer.kind === "outline") {
    const lines = new THREE.LineSegmentsGeometry().setPositions(v);
    const material = new THREE.LineMaterial({ color, linewidth: 2.5 * pixel });
    return [new THREE.LineSegments2(lines, material)];
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(v, 3));
  if (layer.kind === "points") {
    const material = new THREE.PointsMaterial({ color, size: 2.5, sizeAttenuation: false });
    return [new THREE.Points(geometry, material)];
  }
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(bytes(layer.f)), 1));
  geometry.computeVertexNormals();
  if (!layer.tumor) return translucent(geometry, color);
  return [new THREE.Mesh(geometry, new THREE.MeshPhongMaterial({ color }))];
}

/** Fills the element; `show(layers, box)` of what it returns draws a scene. */
function makeView(place) {
  place.innerHTML = `<div class="stage"><canvas tabindex="0" role="img"
    aria-label="3-D view; arrow keys turn it, plus and minus zoom"></canvas>
    <div class="mm"></div></div>
    <div class="legend" role="group" aria-label="parts shown"></div>`;
  const [canvas, bar, legend] = ["canvas", ".mm", ".legend"].map((it) => place.querySelector(it));
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  } catch {
    place.innerHTML = `<p class="missing">This browser offers no WebGL 2, so the 3-D view is missing
      here; everything else on this page is complete.</p>`;
    return { show() {} };
  }
  renderer.setClearColor("#16181d");
  const scene = new THREE.Scene(), group = new THREE.Group(), shown = {};
  const camera = new THREE.OrthographicCamera();
  const lamp = new THREE.DirectionalLight("#ffffff", 1.9);
  lamp.position.set(-0.4, 0.6, 0.9);  // over the viewer's left shoulder
  camera.add(lamp, lamp.target);
  scene.add(camera, group, new THREE.HemisphereLight("#ffffff", "#d8d8e0", 2.1));
  camera.up.set(0, -1, 0);
  camera.position.set(-0.5, -0.55, -1.1);
  const controls = new THREE.OrbitControls(camera, canvas);
  Object.assign(controls, { zoomToCursor: true, zoomSpeed: 3, minZoom: 0.3, maxZoom: 20 });
  let sides = [1, 1, 1], waiting = false;

  function draw() {
    waiting = false;
    const wide = canvas.clientWidth, high = canvas.clientHeight;
    renderer.setPixelRatio(window.devicePixelRatio);
    renderer.setSize(wide, high, false);
    const deep = Math.hypot(...sides);
    // At zoom 1 about the whole box is seen, as it lies at first
    const tall = 0.7 * deep * Math.max(1, (0.9 * high) / wide);
    Object.assign(camera, { top: tall / 2, bottom: -tall / 2, near: -5 * deep, far: 10 * deep });
    camera.right = (camera.top * wide) / high;
    camera.left = -camera.right;
    camera.updateProjectionMatrix();
    const nearer = new THREE.Vector3(0, 0, 1).applyQuaternion(camera.quaternion);
    for (const object of group.children) {
      const { layer } = object.userData, lift = LIFT_MM[layer.tumor ? "tumor" : ""] || 0;
      object.position.copy(nearer).multiplyScalar(LIFT_MM[layer.kind] || lift);
      object.visible = shown[layer.name];
    }
    renderer.render(scene, camera);
    const perMm = (camera.zoom * high) / tall;
    const length = BAR_MM.find((mm) => mm * perMm < wide / 3) || 1;
    bar.style.width = `${length * perMm}px`;
    bar.textContent = `${length} mm`;
  }
  function redraw() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }
  function entry(layer) {
    const button = document.createElement("button"), swatch = document.createElement("i");
    swatch.className = layer.kind;
    swatch.style.color = layer.color || "#ffffff";
    button.append(swatch, layer.name);
    button.setAttribute("aria-pressed", shown[layer.name]);
    button.addEventListener("click", () => {
      shown[layer.name] = !shown[layer.name];
      button.setAttribute("aria-pressed", shown[layer.name]);
      redraw();
    });
    return button;
  }
  function show(layers, box) {
    for (const { geometry, material } of group.children) {
      geometry.dispose();
      material.dispose();
    }
    group.clear();
    sides = box[0].map((low, n) => box[1][n] - low);
    group.position.set(...box[0].map((low, n) => -(low + box[1][n]) / 2));
    for (const layer of layers) {
      shown[layer.name] ??= layer.kind !== "outline" || layer.tumor;
      for (const object of drawn(layer, window.devicePixelRatio)) {
        object.userData = { layer };
        object.frustumCulled = false;
        group.add(object);
      }
    }
    legend.replaceChildren(...layers.map(entry));
    redraw();
  }
  const keys = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;  // the browser's own
    const [left, up] = keys[event.key] || [0, 0];
    if ("+=-".includes(event.key)) camera.zoom *= event.key === "-" ? 0.87 : 1.15;
    else if (!left && !up) return;
    controls.rotateLeft(0.1 * left);
    controls.rotateUp(0.1 * up);
    controls.update();
    redraw();
    event.preventDefault();
  });
  canvas.addEventListener("dblclick", () => controls.reset());
  canvas.addEventListener("webglcontextrestored", redraw);
  controls.addEventListener("change", redraw);
  new ResizeObserver(redraw).observe(canvas);
  return { show };
}

const report = JSON.parse($("data").textContent), scenes = report.scenes, view = makeView($("view"));

function show(index) {
  const scene = scenes[index];
  $("scene").value = index;
  for (const part of ["verdict", "reason", "note"]) $(part).textContent = scene[part];
  $("verdict").style.background = scene.color;
  $("table").innerHTML = scene.rows;
  $("picture").src = "data:image/webp;base64," + scene.picture;
  view.show(scene.layers, scene.box);
}
scenes.forEach((scene, n) => $("scene").add(new Option(`${scene.name} (${scene.verdict})`, n)));
const step = (n) => show((Number($("scene").value) + n + scenes.length) % scenes.length);
$("scene").addEventListener("change", () => show(Number($("scene").value)));
$("previous").addEventListener("click", () => step(-1));
$("next").addEventListener("click", () => step(1));
for (const name of ["typical", "worst"]) $(name).addEventListener("click", () => show(report[name]));
document.querySelectorAll("#all tbody tr").forEach((row, n) =>
  row.firstChild.addEventListener("click", () => {
    show(n);
    $("scene").scrollIntoView({ block: "center" });
  }));
show(report.typical);
