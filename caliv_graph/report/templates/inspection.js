"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data-scene").textContent);
  const byId = function (id) { return document.getElementById(id); };
  const AXES = ["x", "y", "z", "roll", "pitch", "yaw"];
  // Half the way of a slider, metres and degrees; its steps.
  const RANGES = { fine: { xyz: [0.3, 0.005], rpy: [5, 0.05] }, wide: { xyz: [4, 0.02], rpy: [180, 0.5] } };
  const lidars = data.lidars;
  // A drive shows most, if the mountings are about known and the vehicle moves.
  const moves = [0, 1].some(function (i) {
    const way = data.path.map(function (p) { return p[i]; });
    return Math.max(...way) - Math.min(...way) > 3;
  });
  const known = lidars.every(function (lidar) { return lidar.known; });
  let mode = moves && known ? "along" : "once";

  function element(kind, attributes, children) {
    const out = document.createElement(kind);
    for (const [key, value] of Object.entries(attributes || {})) {
      if (key === "text") { out.textContent = value; } else if (key.startsWith("on")) { out.addEventListener(key.slice(2), value); } else { out.setAttribute(key, value); }
    }
    (children || []).forEach(function (child) { out.append(child); });
    return out;
  }
  // As YAML reads a float: with a point.
  function number(value) {
    const text = String(Number(value.toFixed(6)) + 0);
    return /[.e]/.test(text) ? text : text + ".0";
  }
  function list(values) { return "[" + values.map(number).join(", ") + "]"; }

  // ---- the clouds
  lidars.forEach(function (lidar, i) {
    lidar.shown = true;
    lidar.colour = "--lidar-" + (i % 7);
    lidar.now = lidar.xyz.concat(lidar.rpy_deg);
    for (const name of ["once", "along"]) { lidar[name].xyz = decoded(lidar[name].points); }
  });
  function mounting(lidar) { return poseOf(lidar.now.slice(0, 3), lidar.now.slice(3)); }
  // The height below which a tenth of all points are, with the first mountings.
  function groundOf(name) {
    const heights = [];
    for (const lidar of lidars) {
      const T = mounting(lidar), p = lidar[name].xyz;
      const step = Math.max(1, Math.ceil(p.length / 6000));
      let at = 0, k = 0;
      for (const [count, T_view_vehicle] of lidar[name].pieces) {
        const A = compose(T_view_vehicle, T);
        for (const end = at + 3 * count; at < end; at += 3, k += 1) {
          if (k % step === 0) { heights.push(data.quantum_m * (A[8] * p[at] + A[9] * p[at + 1] + A[10] * p[at + 2]) + A[11]); }
        }
      }
    }
    heights.sort(function (a, b) { return a - b; });
    return heights.length ? heights[Math.floor(heights.length / 10)] : 0;
  }
  const groundZ = { once: groundOf("once"), along: groundOf("along") };
  function paintClouds(view, name) {
    const size = Math.max(1, Math.round((view.canvas.clientWidth < 600 ? 1 : 1.5) * view.ratio));
    for (const lidar of lidars) {
      if (lidar.shown) { view.cloud(lidar[name], data.quantum_m, mounting(lidar), view.colour(lidar.colour), groundZ[name], size); }
    }
  }

  // ---- boxes about targets
  const boxes = data.boxes;
  function frameOf(box) { return box.frame === "start" ? data.T_map_start : IDENTITY; }
  function paintBoxes(view, T_view_map) {
    for (const box of boxes) {
      const T = compose(T_view_map, frameOf(box));
      const corner = function (k) { return apply(T, [0, 1, 2].map(function (i) { return k >> i & 1 ? box.max[i] : box.min[i]; })); };
      for (const [a, b] of [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]]) {
        view.line([corner(a), corner(b)], view.colour("--box"), 1.5);
      }
      view.text(corner(7), box.name, view.colour("--box"));
    }
  }

  // ---- the view in space
  const space = new View(byId("space"), function (view) {
    paintClouds(view, mode);
    const along = mode === "along";
    if (along) { view.line(data.path, view.colour("--ink"), 1); }
    if (along || data.T_map_view) { paintBoxes(view, along ? IDENTITY : inverse(data.T_map_view)); }
    const vehicle = along ? data.T_map_start : IDENTITY;
    view.frame(vehicle, 1.2, 3);
    view.text(apply(vehicle, [0, 0, 0]), "vehicle", view.colour("--ink"));
    for (const lidar of lidars) {
      if (!lidar.shown) { continue; }
      const T = compose(vehicle, mounting(lidar));
      view.frame(T, 0.6, 2);
      view.text(apply(T, [0, 0, 0]), lidar.name, view.colour(lidar.colour));
    }
  });
  const SIDES = { oblique: [140, 30], above: [180, 90], left: [90, 0], behind: [180, 0] };
  function look(side) {
    const [azimuth, elevation] = SIDES[side];
    const north = mode === "along" && side === "above";
    Object.assign(space.camera, { azimuth: north ? -90 : azimuth, elevation: elevation });
    const near = [[-11, -11, 0], [11, 11, 3]];
    space.fit(mode === "along" ? data.path : near, mode === "along" ? 12 : 2);
    space.request();
  }
  handle(space, function (x, y, other) {
    return other ? space.pan.bind(space) : space.turn.bind(space);
  }, space.turn.bind(space));
  document.querySelectorAll("[data-side]").forEach(function (button) {
    button.addEventListener("click", function () { look(button.dataset.side); });
  });
  document.querySelectorAll("[name=mode]").forEach(function (radio) {
    radio.checked = radio.value === mode;
    radio.addEventListener("change", function () { mode = radio.value; look("oblique"); });
  });

  // ---- the drive from above
  const map = byId("map") && new View(byId("map"), function (view) {
    paintClouds(view, "along");
    view.line(data.path, view.colour("--ink"), 1.5);
    view.dots(data.fixes, view.colour("--fix"), 1);
    if (data.path.length) { view.dots([data.path[0]], view.colour("--ink"), 4); view.text(data.path[0], "start", view.colour("--ink")); }
    paintBoxes(view, IDENTITY);
    for (const box of boxes) {
      const z = (box.min[2] + box.max[2]) / 2;
      for (const x of [box.min[0], box.max[0]]) {
        for (const y of [box.min[1], box.max[1]]) { view.dots([apply(frameOf(box), [x, y, z])], view.colour("--box"), 4); }
      }
    }
  });
  function fitMap() {
    const corners = boxes.flatMap(function (box) { return [apply(frameOf(box), box.min), apply(frameOf(box), box.max)]; });
    map.fit(data.path.concat(data.fixes, corners), 6);
    map.request();
  }
  // A point of the box's frame, level with its middle.
  function pointIn(box, x, y) {
    const c = map.camera, w = map.canvas.clientWidth, h = map.canvas.clientHeight;
    return apply(inverse(frameOf(box)), [c.centre[0] + (x - w / 2) / c.scale, c.centre[1] - (y - h / 2) / c.scale, 0]);
  }
  function grabbed(x, y) {
    const reach = 10 / map.camera.scale;
    for (const box of boxes) {
      const p = pointIn(box, x, y);
      if (![0, 1].every(function (i) { return p[i] > box.min[i] - reach && p[i] < box.max[i] + reach; })) { continue; }
      const sides = [0, 1].map(function (i) {
        if (Math.abs(p[i] - box.min[i]) < reach) { return "min"; }
        return Math.abs(p[i] - box.max[i]) < reach ? "max" : "";
      });
      return { box: box, sides: sides };
    }
    return null;
  }
  const LEAST_M = 0.1;
  function dragBox(found, dx, dy) {
    const T = frameOf(found.box), s = map.camera.scale, d = [dx / s, -dy / s], whole = !found.sides[0] && !found.sides[1];
    [0, 1].forEach(function (i) {
      const step = T[i] * d[0] + T[4 + i] * d[1];
      if (whole) { found.box.min[i] += step; found.box.max[i] += step; }
      if (found.sides[i] === "min") { found.box.min[i] = Math.min(found.box.min[i] + step, found.box.max[i] - LEAST_M); }
      if (found.sides[i] === "max") { found.box.max[i] = Math.max(found.box.max[i] + step, found.box.min[i] + LEAST_M); }
    });
    boxesChanged();
  }
  if (map) {
    Object.assign(map.camera, { azimuth: -90, elevation: 90 });
    handle(map, function (x, y) {
      const found = grabbed(x, y);
      return found ? function (dx, dy) { dragBox(found, dx, dy); } : map.pan.bind(map);
    }, map.pan.bind(map));
    map.canvas.addEventListener("pointermove", function (event) {
      if (event.buttons) { return; }
      const found = grabbed(event.offsetX, event.offsetY), sides = found ? found.sides : [];
      const both = sides[0] && sides[1];
      map.canvas.style.cursor = !found ? "grab" : both ? "crosshair" : sides[0] ? "ew-resize" : sides[1] ? "ns-resize" : "move";
    });
  }
  document.querySelectorAll("[data-zoom]").forEach(function (button) {
    button.addEventListener("click", function () {
      const view = button.dataset.of === "map" ? map : space;
      view.zoom(Number(button.dataset.zoom), view.canvas.clientWidth / 2, view.canvas.clientHeight / 2);
    });
  });

  // ---- YAML to copy
  function mountingsYaml() {
    return "lidars:\n" + lidars.map(function (lidar) {
      return "  " + lidar.key + ":\n    initial:\n      xyz: " + list(lidar.now.slice(0, 3)) + "\n      rpy_deg: " + list(lidar.now.slice(3)) + "\n";
    }).join("");
  }
  function boxesYaml() {
    if (!boxes.length) { return ""; }
    const round = function (values) { return list(values.map(function (v) { return Number(v.toFixed(3)); })); };
    const one = boxes.length === 1;
    return "target:\n" + boxes.map(function (box) {
      return (one ? "  " : "  - ") + "min: " + round(box.min) + "\n" + (one ? "  " : "    ") + "max: " + round(box.max) + "\n" + (one ? "  " : "    ") + "frame: " + box.frame + "\n";
    }).join("");
  }
  function show(id, text) {
    const area = byId(id);
    area.value = text;
    area.rows = Math.max(2, text.split("\n").length - 1);
  }
  document.querySelectorAll("[data-copy]").forEach(function (button) {
    button.addEventListener("click", function () {
      const area = byId(button.dataset.copy);
      const told = function () { button.textContent = "Copied"; setTimeout(function () { button.textContent = "Copy"; }, 1500); };
      area.focus(); area.select();
      if (navigator.clipboard) { navigator.clipboard.writeText(area.value).then(told, function () { if (document.execCommand("copy")) { told(); } }); } else if (document.execCommand("copy")) { told(); }
    });
  });

  // ---- sliders
  let range = known ? "fine" : "wide";
  function mountingsChanged() {
    show("mountings-yaml", mountingsYaml());
    space.request();
    if (map) { map.request(); }
  }
  function sliderOf(lidar, i, name) {
    const slider = element("input", { type: "range", "aria-label": name }), box = element("input", { type: "number", step: "any", "aria-label": name });
    const centre = function () {
      const [half, step] = RANGES[range][i < 3 ? "xyz" : "rpy"], middle = half >= 180 ? 0 : lidar.now[i];
      Object.assign(slider, { min: middle - half, max: middle + half, step: step });
      slider.value = lidar.now[i];
    };
    const text = function () { box.value = Number(lidar.now[i].toFixed(i < 3 ? 4 : 3)); };
    slider.addEventListener("input", function () { lidar.now[i] = Number(Number(slider.value).toFixed(4)); text(); mountingsChanged(); });
    box.addEventListener("change", function () {
      if (box.value !== "" && isFinite(box.value)) { lidar.now[i] = Number(box.value); centre(); mountingsChanged(); }
    });
    return { parts: [slider, box], reset: function () { centre(); text(); } };
  }
  const resets = [];
  lidars.forEach(function (lidar, index) {
    const rows = element("div", { class: "sliders" }), own = [];
    AXES.forEach(function (axis, i) {
      const made = sliderOf(lidar, i, axis + " of " + lidar.name);
      rows.append(element("span", { text: axis }), ...made.parts, element("span", { class: "unit", text: i < 3 ? "m" : "deg" }));
      own.push(made.reset);
    });
    resets.push(...own);
    const tick = element("input", { type: "checkbox", "aria-label": "show " + lidar.name, onchange: function () { lidar.shown = tick.checked; mountingsChanged(); } });
    tick.checked = true;
    const swatch = element("span", { class: "swatch", style: "background: var(" + lidar.colour + ")" });
    const back = element("button", { type: "button", text: "Reset", onclick: function () { lidar.now = lidar.xyz.concat(lidar.rpy_deg); own.forEach(function (f) { f(); }); mountingsChanged(); } });
    const head = element("summary", {}, [tick, swatch, element("strong", { text: lidar.name })]);
    const details = element("details", {}, [head, element("p", { class: "note", text: lidar.topic + ": " + lidar.origin }), rows, back]);
    details.open = index < 3;
    byId("controls").append(details);
  });
  function recentre() { resets.forEach(function (f) { f(); }); }
  byId("range").value = range;
  byId("range").addEventListener("change", function () { range = byId("range").value; recentre(); });

  // ---- boxes by numbers
  let refreshers = [];
  function boxFields() {
    const place = byId("boxes");
    place.textContent = "";
    refreshers = [];
    boxes.forEach(function (box, k) {
      const rows = element("div", { class: "corners" });
      ["", "x", "y", "z"].forEach(function (name) { rows.append(element("span", { text: name })); });
      for (const side of ["min", "max"]) {
        rows.append(element("span", { text: side }));
        [0, 1, 2].forEach(function (i) {
          const input = element("input", { type: "number", step: "any", "aria-label": side + " " + "xyz"[i] + " of " + box.name });
          refreshers.push(function () { input.value = Number(box[side][i].toFixed(3)); });
          input.addEventListener("change", function () {
            const value = Number(input.value), sound = side === "min" ? value < box.max[i] : value > box.min[i];
            if (input.value !== "" && isFinite(value) && sound) { box[side][i] = value; }
            boxesChanged();
          });
          rows.append(input);
        });
      }
      const gone = element("button", { type: "button", text: "Remove", onclick: function () { boxes.splice(k, 1); boxFields(); boxesChanged(); } });
      const from = element("span", { class: "note", text: box.found ? " found in the drive" : "" });
      place.append(element("div", { class: "box" }, [element("strong", { text: box.name }), from, rows, gone]));
    });
  }
  function boxesChanged() {
    refreshers.forEach(function (f) { f(); });
    show("target-yaml", boxesYaml());
    byId("target-copy").hidden = !boxes.length;
    space.request();
    map.request();
  }
  if (map) {
    byId("add-box").addEventListener("click", function () {
      const c = map.camera.centre, ground = groundZ.along;
      let count = 1;
      while (boxes.some(function (box) { return box.name === "box " + count; })) { count += 1; }
      boxes.push({ name: "box " + count, frame: "map", found: false, min: [c[0] - 1, c[1] - 1, ground - 0.5], max: [c[0] + 1, c[1] + 1, ground + 2] });
      boxFields();
      boxesChanged();
    });
  }

  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", function () { space.request(); if (map) { map.request(); } });
  recentre();
  look("oblique");
  if (map) { fitMap(); }
  if (map) { boxFields(); boxesChanged(); }
  mountingsChanged();
  document.documentElement.dataset.ready = "yes";
})();
