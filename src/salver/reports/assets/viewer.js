// A small WebGL 2 viewer: arm, tray, objects, contact forces, friction cones. Metres, z up.
"use strict";

const Mat = {
  multiply(a, b) {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++)
      for (let r = 0; r < 4; r++) {
        let sum = 0;
        for (let k = 0; k < 4; k++) sum += a[k * 4 + r] * b[c * 4 + k];
        out[c * 4 + r] = sum;
      }
    return out;
  },
  perspective(fovy, aspect, near, far) {
    const f = 1 / Math.tan(fovy / 2), d = 1 / (near - far);
    return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0]);
  },
  lookAt(eye, target) {
    const z = Vec.unit(Vec.sub(eye, target)), x = Vec.unit(Vec.cross([0, 0, 1], z)), y = Vec.cross(z, x);
    return new Float32Array([
      x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0,
      -Vec.dot(x, eye), -Vec.dot(y, eye), -Vec.dot(z, eye), 1,
    ]);
  },
  // Pose (x y z qw qx qy qz), then a scale along the body's axes.
  pose(p, o = 0, s = [1, 1, 1]) {
    const [w, x, y, z] = [p[o + 3], p[o + 4], p[o + 5], p[o + 6]];
    return new Float32Array([
      s[0] * (1 - 2 * (y * y + z * z)), s[0] * 2 * (x * y + w * z), s[0] * 2 * (x * z - w * y), 0,
      s[1] * 2 * (x * y - w * z), s[1] * (1 - 2 * (x * x + z * z)), s[1] * 2 * (y * z + w * x), 0,
      s[2] * 2 * (x * z + w * y), s[2] * 2 * (y * z - w * x), s[2] * (1 - 2 * (x * x + y * y)), 0,
      p[o], p[o + 1], p[o + 2], 1,
    ]);
  },
  // A pose, shifted by p along its own axes.
  moved(m, p) {
    const out = m.slice();
    out.set(Mat.point(m, p), 12);
    return out;
  },
  // Frame at `origin` whose z axis is along `axis`, columns scaled by (across, across, along).
  along(origin, axis, across, length) {
    const z = Vec.unit(axis), helper = Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
    const x = Vec.unit(Vec.cross(helper, z)), y = Vec.cross(z, x);
    return new Float32Array([
      ...Vec.scale(x, across), 0, ...Vec.scale(y, across), 0, ...Vec.scale(z, length), 0, ...origin, 1,
    ]);
  },
  point(m, p) {
    return [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
  },
  direction(m, p) {
    return [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2]);
  },
};

const Vec = {
  sub: (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]],
  add: (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]],
  scale: (a, s) => [a[0] * s, a[1] * s, a[2] * s],
  dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  norm: (a) => Math.hypot(a[0], a[1], a[2]),
  unit: (a) => Vec.scale(a, 1 / (Math.hypot(a[0], a[1], a[2]) || 1)),
};

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
uniform mat4 model, viewProjection;
out vec3 n, p;
void main() {
  vec4 world = model * vec4(position, 1.0);
  p = world.xyz;
  mat3 m = mat3(model);  // its columns are orthogonal: the inverse of its transpose is m over their squares
  n = m * (normal / vec3(dot(m[0], m[0]), dot(m[1], m[1]), dot(m[2], m[2])));
  gl_Position = viewProjection * world;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 n, p;
uniform vec4 colour;
uniform vec3 eye;
uniform vec3 centre;  // of the ground that is drawn: x, y, radius
uniform int mode;  // 0 lit, 1 flat colour, 2 lines on the ground, fading away
out vec4 fragment;
void main() {
  if (mode == 1) { fragment = colour; return; }
  if (mode == 2) { fragment = vec4(colour.rgb, colour.a * smoothstep(1.0, 0.3, length(p.xy - centre.xy) / centre.z)); return; }
  vec3 m = normalize(n), v = normalize(eye - p), key = vec3(0.342, -0.440, 0.830);
  if (dot(m, v) < 0.0) m = -m;
  float sky = 0.5 + 0.5 * m.z;
  vec3 ambient = mix(vec3(0.46, 0.45, 0.44), vec3(0.70, 0.72, 0.76), sky);
  float diffuse = max(dot(m, key), 0.0);
  float glint = max(dot(m, normalize(key + v)), 0.0);
  for (int k = 0; k < 5; k++) glint *= glint;  // to the power of 32
  fragment = vec4(colour.rgb * (ambient * 0.80 + diffuse * 0.50) + 0.18 * glint, colour.a);
}`;

// Normals smooth within a crease angle, sharp across it. Returns interleaved positions and normals of corners, each of
// which once, and the triangles as indices of corners.
function shade(points, triangles, creaseCosine = 0.78) {
  const count = triangles.length / 3, face = new Float32Array(count * 3), at = new Map();
  const corner = (i) => points.slice(3 * i, 3 * i + 3);
  for (let f = 0; f < count; f++) {
    const [a, b, c] = [0, 1, 2].map((k) => corner(triangles[3 * f + k]));
    face.set(Vec.cross(Vec.sub(b, a), Vec.sub(c, a)), 3 * f);  // its length is twice the area: the weight
    for (let k = 0; k < 3; k++) {
      const v = triangles[3 * f + k];
      if (!at.has(v)) at.set(v, { faces: [], made: [] });
      at.get(v).faces.push(f);
    }
  }
  const corners = [], indices = new Uint32Array(3 * count);
  triangles.forEach((v, j) => {
    const { faces, made } = at.get(v), f = Math.floor(j / 3);
    const own = face.subarray(3 * f, 3 * f + 3), size = Vec.norm(own) || 1e-30;
    let sum = [0, 0, 0];
    for (const g of faces) {
      const other = face.subarray(3 * g, 3 * g + 3);
      if (Vec.dot(own, other) >= creaseCosine * size * Vec.norm(other)) sum = Vec.add(sum, other);
    }
    const known = made.find(([n]) => n.every((x, k) => x === sum[k]));
    indices[j] = known ? known[1] : corners.length / 6;
    if (known) return;
    made.push([sum, indices[j]]);
    corners.push(...corner(v), ...Vec.unit(sum));
  });
  return { corners: new Float32Array(corners), indices };
}

// Surfaces of revolution about z through (radius, height) pairs.
function revolve(profile, sides = 28) {
  const points = [], triangles = [];
  for (const [r, z] of profile)
    for (let i = 0; i < sides; i++) points.push(r * Math.cos((2 * Math.PI * i) / sides), r * Math.sin((2 * Math.PI * i) / sides), z);
  for (let ring = 0; ring + 1 < profile.length; ring++)
    for (let i = 0; i < sides; i++) {
      const a = ring * sides + i, b = ring * sides + ((i + 1) % sides);
      triangles.push(a, b, b + sides, a, b + sides, a + sides);
    }
  return shade(points, triangles);
}

// An upright prism, or with another `top` a truncated cone; `open`: its side alone.
function prism(polygon, low, high, open = false, top = polygon) {
  const n = polygon.length, points = [], triangles = [];
  for (const [ring, z] of [[polygon, low], [top, high]]) for (const [x, y] of ring) points.push(x, y, z);
  for (let i = 0; i < n; i++) {
    const j = (i + 1) % n;
    triangles.push(i, j, j + n, i, j + n, i + n);
    if (!open && i > 0 && i + 1 < n) triangles.push(0, i + 1, i, n, n + i, n + i + 1);
  }
  return shade(points, triangles);
}

// A liquid from the bottom (corners) to its surface: a plane through `level` with slopes along x and y, up to the wall,
// which is `wide` times as wide as the bottom at the level and widens by a share `more` of that per height. At the axis
// it is lower, so that the volume stays.
function column({ bottom, level, wall: [wide, more] }, [sx, sy]) {
  const n = bottom.length, points = bottom.flat(), triangles = [];
  const radius = wide * Math.hypot(bottom[0][0] - level[0], bottom[0][1] - level[1]), steep = more * radius * radius * (sx * sx + sy * sy);
  const low = -steep / (1 + Math.sqrt(Math.max(0, 1 - more * steep)));
  for (const corner of bottom) {
    const x = wide * (corner[0] - level[0]), y = wide * (corner[1] - level[1]), plane = sx * x + sy * y;
    const rise = (plane + low) / (1 - more * plane), out = 1 + more * rise;
    points.push(level[0] + out * x, level[1] + out * y, level[2] + rise);
  }
  points.push(level[0], level[1], level[2] + low);
  for (let i = 0; i < n; i++) {
    const j = (i + 1) % n;
    triangles.push(i, j, j + n, i, j + n, i + n, 2 * n, i + n, j + n);
  }
  return shade(points, triangles);
}

// Triangles, each of three corners.
const solid = (triangles) => shade(triangles.flat(2), triangles.flatMap((_, i) => [3 * i, 3 * i + 1, 3 * i + 2]));

function tube(path, radius, sides = 6) {
  const points = [], triangles = [];
  const n = path.length;
  for (let i = 0; i < n; i++) {
    const axis = Vec.sub(path[Math.min(i + 1, n - 1)], path[Math.max(i - 1, 0)]);
    const m = Mat.along(path[i], Vec.norm(axis) > 0 ? axis : [0, 0, 1], radius, 1);
    for (let k = 0; k < sides; k++)
      points.push(...Mat.point(m, [Math.cos((2 * Math.PI * k) / sides), Math.sin((2 * Math.PI * k) / sides), 0]));
    if (i > 0)
      for (let k = 0; k < sides; k++) {
        const a = (i - 1) * sides + k, b = (i - 1) * sides + ((k + 1) % sides);
        triangles.push(a, b, b + sides, a, b + sides, a + sides);
      }
  }
  return shade(points, triangles);
}

// Lines of a square grid on the ground, of half width `half`.
function grid(step, half) {
  const n = Math.ceil(half / step), corners = [];
  for (let i = -n; i <= n; i++)
    for (const j of [-n, n]) corners.push(i * step, j * step, 0, 0, 0, 1);
  for (let i = -n; i <= n; i++)
    for (const j of [-n, n]) corners.push(j * step, i * step, 0, 0, 0, 1);
  return { corners: new Float32Array(corners), indices: Uint32Array.from({ length: corners.length / 6 }, (_, i) => i) };
}

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out.buffer;
}

const float32 = (text) => new Float32Array(bytes(text));

function unpackMesh(mesh) {
  const q = new Uint16Array(bytes(mesh.vertices)), points = new Array(q.length);
  for (let i = 0; i < q.length; i++) points[i] = mesh.low[i % 3] + (mesh.span[i % 3] * q[i]) / 65535;
  return shade(points, Array.from(new Uint16Array(bytes(mesh.triangles))));
}

// The frame before time t and how far t lies towards the next one.
function locate(times, t) {
  const last = times.length - 1;
  if (t <= times[0]) return [0, 0];
  if (t >= times[last]) return [last, 0];
  let low = 0, high = last;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle;
    else high = middle;
  }
  return [low, (t - times[low]) / (times[high] - times[low])];
}

// Poses (7 numbers each) of `count` bodies at time t: positions linearly, quaternions by normalised interpolation.
function posesAt(track, times, count, t) {
  const [i, u] = locate(times, t), width = 7 * count, out = new Float32Array(width), j = u > 0 ? i + 1 : i;
  for (let k = 0; k < count; k++) {
    const a = i * width + 7 * k, b = j * width + 7 * k;
    let sign = 0;
    for (let c = 3; c < 7; c++) sign += track[a + c] * track[b + c];
    sign = sign < 0 ? -1 : 1;
    let norm = 0;
    for (let c = 0; c < 7; c++) {
      const other = c < 3 ? track[b + c] : sign * track[b + c];
      out[7 * k + c] = (1 - u) * track[a + c] + u * other;
      if (c >= 3) norm += out[7 * k + c] ** 2;
    }
    for (let c = 3; c < 7; c++) out[7 * k + c] /= Math.sqrt(norm);
  }
  return out;
}

function valuesAt(track, times, width, t) {
  const [i, u] = locate(times, t), j = u > 0 ? i + 1 : i, out = [];
  for (let k = 0; k < width; k++) out.push((1 - u) * track[i * width + k] + u * track[j * width + k]);
  return out;
}

// Whether the processor draws: smooth edges would take half of its time.
function inSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2"), info = gl?.getExtension("WEBGL_debug_renderer_info");
  return Boolean(gl) && /swiftshader|llvmpipe|software|basic render/i.test(gl.getParameter(info?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER));
}

function createViewer(canvas, scene) {
  const gl = canvas.getContext("webgl2", { antialias: !inSoftware(), stencil: true, alpha: true, preserveDrawingBuffer: true });
  if (!gl) return null;
  const program = compile(gl), where = {};
  for (const name of ["model", "viewProjection", "colour", "eye", "centre", "mode"]) where[name] = gl.getUniformLocation(program, name);

  let bounds, middle, reach, around, shapes, links, obstacles, objects, variants;

  const refill = (shape, { corners, indices }) => {
    gl.bindVertexArray(shape.array);
    for (const [i, [kind, data]] of [[gl.ARRAY_BUFFER, corners], [gl.ELEMENT_ARRAY_BUFFER, indices]].entries()) {
      gl.bindBuffer(kind, shape.buffers[i]);
      gl.bufferData(kind, data, gl.DYNAMIC_DRAW);
    }
    shape.count = indices.length;
  };
  const upload = (data) => {
    const shape = { array: gl.createVertexArray(), buffers: [gl.createBuffer(), gl.createBuffer()] };
    refill(shape, data);
    for (const k of [0, 1]) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
    }
    return shape;
  };

  // What is drawn, from the scene; with some of it replaced. Where links are not, those that there are stay.
  const furniture = [];
  function furnish(fresh) {
    scene = { ...scene, ...fresh };
    for (const { array, buffers } of furniture.splice(0)) [gl.deleteVertexArray(array), ...buffers.map((b) => gl.deleteBuffer(b))];
    const made = (data) => (furniture.push(upload(data)), furniture[furniture.length - 1]);
    bounds = scene.bounds;
    middle = bounds[0].map((x, i) => (x + bounds[1][i]) / 2);
    reach = Vec.norm(Vec.sub(bounds[1], bounds[0]));
    const box = ([[x, y, z], size]) => {
      const [a, b, c] = size.map((s) => s / 2);
      return prism([[x + a, y + b], [x - a, y + b], [x - a, y - b], [x + a, y - b]], z - c, z + c);
    };
    around = 1.45 * Math.max(reach, 1);
    shapes = {
      grids: [0.1, 0.5].map((step) => ({ ...made(grid(step, around)), kind: gl.LINES })),
      tray: scene.tray.boxes.map((one) => made(box(one))),
      post: made(tube(scene.tray.post, 0.029, 28)),
      shaft: made(revolve([[0, 0], [1, 0], [1, 1], [0, 1]], 14)),
      head: made(revolve([[0, 0], [1, 0], [0, 1]], 18)),
      cone: made(revolve([[0, 0], [1, 1]], 40)),
      rim: made(revolve([[1, 1], [0.985, 0.985]], 40)),
    };
    if (!links || fresh.meshes) links = scene.meshes.map((mesh) => ({ name: mesh.name, shape: upload(unpackMesh(mesh)), joint: mesh.joint, colour: mesh.colour }));
    obstacles = scene.obstacles.map((mesh) => ({ name: mesh.name, shape: made(unpackMesh(mesh)), colour: mesh.colour }));
    objects = scene.objects.map((o) => ({
      name: o.name,
      shape: made(o.polygon ? prism(o.polygon, o.low, o.high, o.open, o.top) : shade(o.points.flat(), o.triangles.flat())),
      edges: o.polygon ? o.polygon.flatMap((p, i) => {
        const n = o.polygon.length, up = [...o.top[i], o.high], low = [...p, o.low];
        const rims = [[o.polygon, o.low], [o.top, o.high]].map(([ring, z]) => [[...ring[i], z], [...ring[(i + 1) % n], z]]);
        return n <= 8 ? [...rims, [low, up]] : rims;
      }) : [],
      colour: o.colour,
    }));
    variants = scene.variants.map((v) => ({
      ...v,
      joints: float32(v.joints), tray: float32(v.tray), objects: float32(v.objects), forces: float32(v.forces ?? ""), contacts: float32(v.contacts ?? ""),
      path: made(tube(v.path, 0.0011 * reach)),
      inside: v.inside.map((l) => l && { ...l, moves: float32(l.moves), shape: made(l.triangles ? solid(l.triangles) : column(l, [0, 0])) }),
    }));
  }
  furnish({});

  const options = { forces: false, cones: false, path: true, layout: "side", camera: "whole", dark: false };
  const home = { azimuth: scene.azimuth, elevation: 0.3, distance: 1, pan: [0, 0, 0] }, orbit = { ...home };

  function draw(shape, model, colour, mode = 0) {
    gl.uniformMatrix4fv(where.model, false, model);
    gl.uniform4fv(where.colour, colour);
    gl.uniform1i(where.mode, mode);
    gl.bindVertexArray(shape.array);
    gl.drawElements(shape.kind ?? gl.TRIANGLES, shape.count, gl.UNSIGNED_INT, 0);
  }

  const marks = [];  // of the page that shows it: {shape, model, colour, flat}
  let seen = null, cells = [1, 1], cell = [0, 0];  // the camera of the last picture, how many it has, which is pointed at
  const identity = Mat.pose([0, 0, 0, 1, 0, 0, 0]);
  const light = Vec.unit([0.35, -0.45, 0.85]);
  const [sx, sy] = [light[0] / light[2], light[1] / light[2]], ground = scene.floor + 0.001;
  const flatten = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, -sx, -sy, 0, 0, sx * ground, sy * ground, ground, 1]);

  // The colour of a part: red where the variant says that it touches something.
  const marked = (variant, part) => (variant.red?.includes(part.name) ? [0.85, 0.08, 0.1] : part.colour);

  function solids(variant, t) {
    const list = [], joints = posesAt(variant.joints, variant.t, scene.joints, t);
    const tray = Mat.pose(posesAt(variant.tray, variant.t, 1, t));
    for (const link of links) list.push([link.shape, Mat.pose(joints, 7 * link.joint), marked(variant, link)]);
    const paint = options.dark ? scene.tray.colour.map((c) => 0.42 + 0.5 * c) : scene.tray.colour;
    for (const box of shapes.tray) list.push([box, tray, marked(variant, { name: "tray", colour: paint })]);
    if (scene.meshes.length) list.push([shapes.post, tray, [0.35, 0.37, 0.4]]);
    const poses = posesAt(variant.objects, variant.t, objects.length, t);
    objects.forEach((o, i) => list.push([o.shape, Mat.pose(poses, 7 * i), marked(variant, o), { ...o, inside: variant.inside[i] }]));
    return { list, poses };
  }

  function drawContacts(variant, t, B) {
    const n = variant.contactCount, force = valuesAt(variant.forces, variant.t, 3 * n, t);
    const points = valuesAt(variant.contacts, variant.t, 3 * n, t), mu = variant.friction;
    const normal = Vec.unit(Mat.direction(B, scene.contacts.normal));
    const translucent = [];
    for (let i = 0; i < n; i++) {
      const at = points.slice(3 * i, 3 * i + 3), f = force.slice(3 * i, 3 * i + 3), size = Vec.norm(f);
      const across = Vec.sub(f, Vec.scale(normal, Vec.dot(f, normal)));
      const inside = Vec.norm(across) <= mu * Vec.dot(f, normal) + 1e-6;
      const colour = inside ? [0.0, 0.45, 0.70, 1] : [0.84, 0.29, 0.0, 1];
      if (options.forces && size > 1e-6) {
        const length = size * variant.metresPerNewton, head = Math.min(0.011, 0.5 * length), axis = Vec.unit(f);
        draw(shapes.shaft, Mat.along(at, f, 0.0013, length - head), colour);
        draw(shapes.head, Mat.along(Vec.add(at, Vec.scale(axis, length - head)), f, 0.0038, head), colour);
      }
      if (options.cones) translucent.push([at, normal, mu, inside]);
    }
    return translucent;
  }

  function drawConesOf(list) {
    const height = scene.contacts.coneHeight;
    for (const [at, normal, mu, inside] of list) {
      const rgb = inside ? [0.0, 0.62, 0.45] : [0.84, 0.29, 0.0], model = Mat.along(at, normal, mu * height, height);
      draw(shapes.cone, model, [...rgb, 0.22]);
      draw(shapes.rim, model, [...rgb, 0.8], 1);
    }
  }

  const loop = (points) => points.map((p, i) => [p, points[(i + 1) % points.length]]);

  function drawEdges(edges, model, colour, radius = 0.0005) {
    for (const [a, b] of edges) {
      const p = Mat.point(model, a), q = Mat.point(model, b), d = Vec.sub(q, p);
      draw(shapes.shaft, Mat.along(p, d, radius, Vec.norm(d)), colour, 1);
    }
  }

  // What moves inside an object: a liquid with slopes along x and y, or a solid that is moved along x, y and z.
  function drawInside(inside, variant, t, model) {
    if (inside.triangles) draw(inside.shape, Mat.moved(model, valuesAt(inside.moves, variant.t, 3, t)), [...inside.colour, 1]);
    else {
      refill(inside.shape, column(inside, valuesAt(inside.moves, variant.t, 2, t)));
      draw(inside.shape, model, [...inside.colour, 1]);
    }
    const beyond = inside.beyond !== null && t >= inside.beyond;
    drawEdges(loop(inside.edge), model, [...(beyond ? scene.edge.beyond : scene.edge.kept), 1], beyond ? 0.0016 : 0.0009);
  }

  const FOV = 0.6;  // rad, upright
  const eyeward = (azimuth, elevation) => {
    const c = Math.cos(elevation);
    return [c * Math.cos(azimuth), c * Math.sin(azimuth), Math.sin(elevation)];
  };

  // From how far all corners of the scene's bounds are in the picture, whatever its shape, seen from where it begins.
  function fitting(aspect) {
    const back = eyeward(home.azimuth, home.elevation), right = Vec.unit(Vec.cross([0, 0, 1], back)), up = Vec.cross(back, right);
    const half = 0.96 * Math.tan(FOV / 2);
    let distance = 0;
    for (let i = 0; i < 8; i++) {
      const corner = Vec.sub([0, 1, 2].map((k) => bounds[(i >> k) & 1][k]), middle);
      const [x, y] = [right, up].map((axis) => Math.abs(Vec.dot(corner, axis)));
      distance = Math.max(distance, Vec.dot(corner, back) + Math.max(x / (half * aspect), y / half));
    }
    return distance;
  }

  function camera(pane, t, aspect) {
    let target = middle, distance = fitting(aspect);
    if (options.camera === "close") {
      const tray = posesAt(pane[0].variant.tray, pane[0].variant.t, 1, t);
      target = [tray[0], tray[1], tray[2] + 0.45 * scene.loadHeight];
      distance = (1.9 * Math.max(...scene.tray.size, 1.35 * scene.loadHeight)) / Math.min(1, aspect);
    }
    target = Vec.add(target, orbit.pan);
    distance *= orbit.distance;
    const eye = Vec.add(target, Vec.scale(eyeward(orbit.azimuth, orbit.elevation), distance));
    return { eye, target, distance };
  }

  function renderPane(pane, t, x, y, width, height) {
    gl.viewport(x, y, width, height);
    gl.scissor(x, y, width, height);
    const aspect = width / height, { eye, target, distance } = camera(pane, t, aspect);
    seen = { eye, target, aspect };
    const matrix = Mat.multiply(Mat.perspective(FOV, aspect, 0.02 * distance, 20 * distance), Mat.lookAt(eye, target));
    gl.uniformMatrix4fv(where.viewProjection, false, matrix);
    gl.uniform3fv(where.eye, eye);
    gl.uniform3fv(where.centre, [middle[0], middle[1], around]);
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    const centre = Mat.pose([0.5 * Math.round(2 * middle[0]), 0.5 * Math.round(2 * middle[1]), scene.floor, 1, 0, 0, 0]);
    shapes.grids.forEach((lines, i) => draw(lines, centre, [0.7, 0.73, 0.77, [0.35, 0.55][i]], 2));
    gl.depthMask(true);
    const seeInside = options.forces || options.cones;
    for (const { variant, ghost } of pane) {
      const { list, poses } = solids(variant, t);
      if (!ghost) {  // shadow on the ground, each pixel darkened once
        gl.enable(gl.STENCIL_TEST);
        gl.stencilFunc(gl.EQUAL, 0, 255);
        gl.stencilOp(gl.KEEP, gl.INCR, gl.INCR);
        gl.depthMask(false);
        for (const [shape, model] of list) draw(shape, Mat.multiply(flatten, model), [0.1, 0.12, 0.16, 0.13], 1);
        gl.depthMask(true);
        gl.disable(gl.STENCIL_TEST);
      }
      const tint = (c) => (ghost ? c.map((x, i) => 0.45 * x + 0.55 * variant.colour[i]) : c);
      if (options.path) draw(variant.path, identity, [...variant.colour.map((c) => (options.dark ? Math.min(1, 1.35 * c + 0.1) : c)), 1]);
      if (ghost) {  // depth first, then colour: only the nearest surface of the ghost shows; behind what coincides
        gl.enable(gl.POLYGON_OFFSET_FILL);
        gl.polygonOffset(2, 2);
        gl.colorMask(false, false, false, false);
        for (const [shape, model] of list) draw(shape, model, [0, 0, 0, 1], 1);
        gl.colorMask(true, true, true, true);
        gl.depthFunc(gl.LEQUAL);
        for (const [shape, model, colour] of list) draw(shape, model, [...tint(colour), 0.35]);
        gl.depthFunc(gl.LESS);
        gl.disable(gl.POLYGON_OFFSET_FILL);
        continue;
      }
      const seenThrough = [];
      for (const [shape, model, colour, object] of list) {
        if (object?.inside) drawInside(object.inside, variant, t, model);
        if (object && seeInside) drawEdges(object.edges, model, [...colour.map((x) => 0.55 * x), 1]);
        if (object && (seeInside || object.inside)) seenThrough.push([shape, model, [...colour, seeInside ? 0.22 : scene.wallOpacity]]);
        else draw(shape, model, [...colour, 1]);
      }
      const cones = seeInside ? drawContacts(variant, t, Mat.pose(poses)) : [];
      gl.depthMask(false);
      drawConesOf(cones);
      gl.enable(gl.CULL_FACE);  // its far side, and the base that lies in the tray's surface, would shine through
      for (const piece of seenThrough) draw(...piece);
      gl.disable(gl.CULL_FACE);
      gl.depthMask(true);
    }
    for (const mark of marks) draw(mark.shape, mark.model, mark.colour, mark.flat ? 1 : 0);
    gl.enable(gl.CULL_FACE);  // last, and seen through: nothing hides behind an obstacle
    for (const o of obstacles) draw(o.shape, identity, [...marked(variants.find((v) => v.red?.includes(o.name)) ?? {}, o), 0.55]);
    gl.disable(gl.CULL_FACE);
  }

  function panes() {
    const all = variants.map((variant) => ({ variant, ghost: false }));
    if (options.layout === "side" || all.length === 1) return all.map((x) => [x]);
    if (options.layout === "overlay") return [[all[0], ...all.slice(1).map((x) => ({ ...x, ghost: true }))]];
    return [[all[0]]];
  }

  function render(t) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(2, Math.round(canvas.clientWidth * ratio)), height = Math.max(2, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.SCISSOR_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    // Side by side, or one above the other where that would make towers of them.
    const list = panes(), n = list.length, stacked = n > 1 && width / n < 0.8 * height;
    const [w, h] = stacked ? [width, Math.floor(height / n)] : [Math.floor(width / n), height];
    cells = stacked ? [1, n] : [n, 1];
    list.forEach((pane, i) => (stacked ? renderPane(pane, t, 0, height - (i + 1) * h, w, h) : renderPane(pane, t, i * w, 0, w, h)));
    return { stacked, shown: list.map((pane) => pane.map(({ variant }) => variant.key)) };
  }

  // Where a point of the picture (0 to 1 from the left, from the top) lies: a point and a direction from it, unit.
  function ray(x, y) {
    const forward = Vec.unit(Vec.sub(seen.target, seen.eye)), right = Vec.unit(Vec.cross(forward, [0, 0, 1])), up = Vec.cross(right, forward);
    const h = Math.tan(FOV / 2), [a, b] = [(2 * x - 1) * h * seen.aspect, (1 - 2 * y) * h];
    return [seen.eye, Vec.unit(Vec.add(forward, Vec.add(Vec.scale(right, a), Vec.scale(up, b))))];
  }

  // The ray through the place of a pointer; of one that drags, in the picture where it began.
  function pointed(event) {
    const box = canvas.getBoundingClientRect();
    const at = [(cells[0] * (event.clientX - box.left)) / box.width, (cells[1] * (event.clientY - box.top)) / box.height];
    if (event.type !== "pointermove" || !event.buttons) cell = at.map((x, k) => Math.min(Math.max(Math.floor(x), 0), cells[k] - 1));
    return ray(at[0] - cell[0], at[1] - cell[1]);
  }

  // The point of that ray on a plane through p, level or upright and facing the camera; null where there is none.
  function onPlane(event, p, upright) {
    const [eye, way] = pointed(event);
    const normal = upright ? Vec.unit([eye[0] - p[0], eye[1] - p[1], 0]) : [0, 0, 1], facing = Vec.dot(way, normal);
    const far = Math.abs(facing) < 1e-3 ? -1 : Vec.dot(Vec.sub(p, eye), normal) / facing;
    return far > 0 && far < 10 ? Vec.add(eye, Vec.scale(way, far)) : null;
  }

  // By how much that ray misses p: m, and pixels.
  function missed(event, p) {
    const [eye, way] = pointed(event), to = Vec.sub(p, eye), along = Vec.dot(to, way), off = Vec.norm(Vec.sub(to, Vec.scale(way, along)));
    return [off, off / ((2 * along * Math.tan(FOV / 2)) / (canvas.getBoundingClientRect().height / cells[1]))];
  }

  const reset = () => Object.assign(orbit, home, { pan: [0, 0, 0] });
  return { options, orbit, render, reset, ray, onPlane, missed, furnish, get variants() { return variants; }, marks, upload, refill };
}

function compile(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}

// Returns what starts and ends that state.time runs from span()[0] to span()[1], state.speed times as fast as the clock:
// show(t) draws it, told(on) says whether it runs.
function player(state, span, show, told) {
  return (on) => {
    const mine = (state.playing = on && {});
    told(on);
    if (!on) return;
    if (state.time >= span()[1] - 1e-6) show(span()[0]);
    let last = null;
    const step = (now) => {
      if (state.playing !== mine) return;
      if (last !== null) show(Math.min(span()[1], state.time + ((now - last) / 1000) * state.speed));
      last = now;
      if (state.time < span()[1]) return requestAnimationFrame(step);
      state.playing = false;
      told(false);
    };
    requestAnimationFrame(step);
  };
}

// Drag turns, wheel zooms, shift-drag moves; changed() is called after each, and when the canvas or the light changes.
function attachView(canvas, viewer, changed) {
  let last = null;
  const darkness = window.matchMedia("screen and (prefers-color-scheme: dark)"), dark = () => ((viewer.options.dark = darkness.matches), changed());
  viewer.options.dark = darkness.matches;
  darkness.addEventListener("change", dark);
  new ResizeObserver(changed).observe(canvas);
  canvas.addEventListener("pointerdown", (event) => {
    last = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointerup", () => (last = null));
  canvas.addEventListener("pointermove", (event) => {
    if (!last) return;
    const dx = event.clientX - last[0], dy = event.clientY - last[1], o = viewer.orbit;
    last = [event.clientX, event.clientY];
    if (event.shiftKey) {
      const s = 0.0016 * o.distance;
      o.pan = Vec.add(o.pan, [s * dx * Math.sin(o.azimuth), -s * dx * Math.cos(o.azimuth), s * dy]);
    } else {
      o.azimuth -= 0.008 * dx;
      o.elevation = Math.max(-0.1, Math.min(1.5, o.elevation + 0.006 * dy));
    }
    changed();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    viewer.orbit.distance = Math.max(0.15, Math.min(4, viewer.orbit.distance * Math.exp(0.0012 * event.deltaY)));
    changed();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => {
    viewer.reset();
    changed();
  });
}
