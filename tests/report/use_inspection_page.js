// What a person does on the page of `inspect --html`; POSES and BOX are replaced by the test.
const told = {};
told.poses = POSES.map(function (p) { return poseOf(p[0], p[1]); });
told.composed = compose(told.poses[0], told.poses[1]);
told.inverse = inverse(told.poses[2]);
told.applied = apply(told.poses[3], [1, 2, 3]);
const data = JSON.parse(document.getElementById("data-scene").textContent);
told.points = Array.from(decoded(data.lidars[0].once.points));
told.before = document.getElementById("mountings-yaml").value;
told.boxesBefore = document.getElementById("target-yaml").value;

// A slider and a number, as a person moves them.
const input = function (kind, label) { return document.querySelector("input[type=" + kind + "][aria-label='" + label + "']"); };
const slider = input("range", "yaw of front");
told.range = [Number(slider.min), Number(slider.max)];
slider.value = -31.5; slider.dispatchEvent(new Event("input"));
const z = input("number", "z of front");
z.value = "7.25"; z.dispatchEvent(new Event("change"));
told.slider = Number(input("range", "z of front").value);
told.after = document.getElementById("mountings-yaml").value;

// One point of a view of its own, where it has to be.
const canvas = document.createElement("canvas");
canvas.style = "width: 200px; height: 100px";
document.body.append(canvas);
const cloud = { xyz: Int16Array.from([1000, 0, 0]), pieces: [[1, poseOf([1, 0, 0], [0, 0, 90])]] };
const view = new View(canvas, function (v) { v.cloud(cloud, 0.002, poseOf([0, 1, 0], [0, 0, 0]), "#0072b2", -9, 1); });
// From above: the point is at (0, 2, 0) in the map.
Object.assign(view.camera, { azimuth: -90, elevation: 90, scale: 20 });
view.draw();
const shot = view.context.getImageData(0, 0, canvas.width, canvas.height).data;
told.blue = [];
for (let i = 0; i < shot.length; i += 4) {
  if (shot[i] === 0 && shot[i + 1] === 114) { told.blue.push([i / 4 % canvas.width, Math.floor(i / 4 / canvas.width)]); }
}
told.projected = view.project([0, 2, 0]);
told.painted = ["space", "map"].map(function (id) {
  const c = document.getElementById(id), p = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
  const colours = new Set();
  for (let i = 0; i < p.length; i += 4) { colours.add(p[i] << 16 | p[i + 1] << 8 | p[i + 2]); }
  return colours.size;
});

// The box by its middle and by its side, in the map. What a pixel is, the first drag tells.
const map = document.getElementById("map"), at = map.getBoundingClientRect();
const fire = function (kind, x, y) {
  map.dispatchEvent(new PointerEvent(kind, { pointerId: 1, clientX: at.left + map.clientLeft + x, clientY: at.top + map.clientTop + y, buttons: kind === "pointerup" ? 0 : 1 }));
};
const drag = function (from, to) { fire("pointerdown", from[0], from[1]); fire("pointermove", to[0], to[1]); fire("pointerup", to[0], to[1]); };
// The map fits path, fixes and boxes, 6 m wider, about their middle.
const low = [Math.min(0, BOX[0][0]), Math.min(-1, BOX[0][1])], high = [Math.max(20, BOX[1][0]), Math.max(2, BOX[1][1])];
const s = Math.min(map.clientWidth / (high[0] - low[0] + 6), map.clientHeight / (high[1] - low[1] + 6));
const pixel = function (x, y) { return [map.clientWidth / 2 + s * (x - (low[0] + high[0]) / 2), map.clientHeight / 2 - s * (y - (low[1] + high[1]) / 2)]; };
drag(pixel(10, 0.5), pixel(11, -1.5));
told.moved = document.getElementById("target-yaml").value;
drag(pixel(12, -1.5), pixel(13.5, -1.5));
told.sized = document.getElementById("target-yaml").value;
document.getElementById("add-box").click();
told.added = document.getElementById("target-yaml").value;
told.ready = document.documentElement.dataset.ready;
const out = document.createElement("pre");
out.id = "told"; out.textContent = JSON.stringify(told);
document.body.append(out);
