"""The page around a report's data: layout, style and the script that draws a scene."""

PAGE = r"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:; worker-src blob:;
 style-src 'unsafe-inline'; img-src data: blob:; connect-src 'none'">
<title>tumortrack: located tumors</title>
<style>
 body { font: 15px/1.45 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; margin: 0;
        color: #1d2530; background: #f3f5f7; }
 header { background: #12304f; color: #fff; padding: 18px 28px 14px; }
 h1 { font-size: 22px; margin: 0 0 2px; } header p { margin: 0; color: #cfdcea; }
 main { max-width: 1280px; margin: 0 auto; padding: 16px 20px 40px; }
 section { background: #fff; border: 1px solid #dde3e9; border-radius: 8px; padding: 14px 18px;
           margin: 14px 0; }
 h2 { font-size: 16px; margin: 0 0 8px; }
 .notice { background: #fff6e0; border-color: #e5c36a; padding: 9px 18px; }
 table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
 th, td { padding: 4px 14px 4px 0; text-align: right; border-bottom: 1px solid #e6eaee; }
 tr > th:first-child { text-align: left; } thead th { color: #566473; font-weight: 600; }
 .rule { color: #566473; font-size: 13px; margin: 8px 0 0; max-width: 90ch; }
 .bar { display: flex; gap: 10px; align-items: center; flex-wrap: wrap; margin-bottom: 8px; }
 select, button { font: inherit; padding: 4px 10px; border: 1px solid #b9c3cd;
                  border-radius: 6px; background: #fff; }
 #view { width: 100%; height: 600px; } #picture { width: 100%; height: auto; display: block; }
</style></head><body>
<header><h1>Tumors located from one depth image</h1>
<p>tumortrack: estimate against truth, scene by scene</p></header>
<main>
<section class="notice"><b>For research use only.</b> Not a medical device; not for diagnosis,
 planning or guidance of treatment.</section>
<section><h2>Summary: medians over the scenes</h2><p>@COUNTS@</p>@SUMMARY@
<p class="rule">@RULE@</p></section>
<section><div class="bar"><label for="scene"><b>Scene</b></label><select id="scene"></select>
<button id="previous">previous</button><button id="next">next</button><span id="note"></span></div>
<div id="table"></div><div id="view"></div>
<p class="rule">Drag to turn, wheel to zoom, click a legend entry to hide or show it. Camera frame
in mm: x right, y down, z away from the camera. Orange and gold: estimated tumors. Blue wire: true
tumors. Grey points: what the sensor saw.</p></section>
<section><h2>Views and slices</h2><img id="picture" alt="estimate over truth"></section>
</main>
<script>@PLOTLY@</script>
<script id="data" type="application/json">@DATA@</script>
<script>
"use strict";
const scenes = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const tumorColors = ["#e68c00", "#f2c230", "#cc6677", "#aa4499"];

function bytes(text) {
  return Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
}
function columns(flat) {
  const out = [[], [], []];
  for (let n = 0; n < flat.length; n++) out[n % 3].push(flat[n]);
  return out;
}
function wire(vertices, faces) {
  const seen = new Set(), line = [[], [], []];
  for (let f = 0; f < faces.length; f += 3) {
    for (let e = 0; e < 3; e++) {
      const a = Math.min(faces[f + e], faces[f + (e + 1) % 3]);
      const b = Math.max(faces[f + e], faces[f + (e + 1) % 3]);
      const key = a * 1048576 + b;
      if (seen.has(key)) continue;
      seen.add(key);
      for (let k = 0; k < 3; k++) line[k].push(vertices[3 * a + k], vertices[3 * b + k], null);
    }
  }
  return line;
}
function trace(layer) {
  const vertices = new Float32Array(bytes(layer.v)), [x, y, z] = columns(vertices);
  if (layer.kind === "points") {
    return { type: "scatter3d", mode: "markers", x, y, z, name: layer.name, hoverinfo: "skip",
             showlegend: true, marker: { size: 2, color: "#444444" } };
  }
  const faces = new Uint32Array(bytes(layer.f)), [i, j, k] = columns(faces);
  if (layer.kind === "wire") {
    const [wx, wy, wz] = wire(vertices, faces);
    return { type: "scatter3d", mode: "lines", x: wx, y: wy, z: wz, name: layer.name,
             hoverinfo: "skip", showlegend: true, line: { color: "#005aa0", width: 2 } };
  }
  const kidney = layer.part === "kidney", truth = layer.kind === "truth";
  const number = Number(layer.part.split("_")[1] || 1);
  return { type: "mesh3d", x, y, z, i, j, k, name: layer.name, hoverinfo: "name",
           showlegend: true, visible: truth ? "legendonly" : true,
           color: truth ? "#005aa0" : kidney ? "#b96653" : tumorColors[(number - 1) % 4],
           opacity: kidney ? 0.28 : 1, flatshading: false,
           lighting: { ambient: 0.7, diffuse: 0.5, specular: 0.2, roughness: 0.5, fresnel: 0.1 },
           lightposition: { x: -60000, y: 100000, z: 0 } };
}
const axis = (title) => ({ title: { text: title }, backgroundcolor: "#fafbfc",
                           showbackground: true, gridcolor: "#dde3e9" });
const layout = {
  margin: { l: 0, r: 0, t: 0, b: 0 }, legend: { x: 0.01, y: 0.99 },
  scene: { aspectmode: "data", dragmode: "orbit",
           xaxis: axis("x mm"), yaxis: axis("y mm"), zaxis: axis("z mm"),
           camera: { up: { x: 0, y: -0.6, z: -1 }, eye: { x: -0.38, y: 1.2, z: -1.3 } } },
  uirevision: "one view for all scenes", paper_bgcolor: "#fff",
};
function show(index) {
  const scene = scenes[index];
  $("scene").value = index;
  $("note").textContent = "";
  $("note").innerHTML = scene.note;
  $("table").innerHTML = scene.rows;
  $("picture").src = "data:image/webp;base64," + scene.picture;
  Plotly.react("view", scene.layers.map(trace), layout, { responsive: true, displaylogo: false });
}
scenes.forEach((scene, n) => $("scene").add(new Option(scene.name, n)));
const step = (n) => show((Number($("scene").value) + n + scenes.length) % scenes.length);
$("scene").addEventListener("change", () => show(Number($("scene").value)));
$("previous").addEventListener("click", () => step(-1));
$("next").addEventListener("click", () => step(1));
if (scenes.length) show(0);
</script></body></html>
"""
