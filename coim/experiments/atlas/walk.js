"use strict";
// Policies, bodies and walks. Positions in m; a capsule is [x1, y1, z1, x2, y2, z2, radius].

const TURN = 2 * Math.PI;
const BEYOND_PHYSICS = 1e6; // as coim.envs.simulation: a simulation with such a number is broken
const SPHERE = 2, CAPSULE = 3, ELLIPSOID = 4, CYLINDER = 5, BOX = 6, MESH = 7; // MuJoCo's types of geoms
const FLATTEST = 7, OVERLAP = 1.5; // as coim.envs.rods

const bytes = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
const floats = (base64) => new Float32Array(bytes(base64).buffer);

async function unzipped(base64) {
  const stream = new Blob([bytes(base64)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// Load MuJoCo from what the page holds: its JavaScript module, and its WebAssembly.
async function loadMujoco(module, binary) {
  const address = URL.createObjectURL(new Blob([await unzipped(module)], { type: "text/javascript" }));
  const { default: load } = await import(address);
  URL.revokeObjectURL(address);
  // Without locateFile it would look for an address beside the module's, which has none.
  return load({ wasmBinary: new Uint8Array(await unzipped(binary)), locateFile: (name) => name });
}

// The deterministic action tanh(loc) of a policy: coim.models.Policy.deterministic_action.
class Policy {
  constructor(table) {
    Object.assign(this, { scale: table.observation_scale, centre: table.design_centre, reach: table.design_reach });
    this.layers = table.layers.map(({ width, weights, bias }) => ({ width, weights: floats(weights), bias: floats(bias) }));
  }

  act(observation, design) {
    const scaled = this.scale !== null;
    let values = [
      ...observation.map((value, i) => (scaled ? value / this.scale[i] : value)),
      ...design.map((value, i) => (scaled ? (value - this.centre[i]) / this.reach[i] : value)),
    ];
    this.layers.forEach(({ width, weights, bias }, layer) => {
      const sums = Float64Array.from(bias);
      values.forEach((value, i) => {
        if (value !== 0) for (let j = 0; j < width; j++) sums[j] += value * weights[i * width + j];
      });
      const last = layer === this.layers.length - 1;
      values = Array.from(sums, last ? Math.tanh : (value) => Math.max(value, 0));
    });
    return values;
  }
}

// MJCF text of a design: coim.envs.written_body.WrittenBody.
function filled(body, design, start) {
  const inputs = [1, ...design, start];
  const numbers = body.slots.map((slot) => String(slot.reduce((sum, factor, i) => sum + factor * inputs[i], 0)));
  return body.texts.map((text, i) => text + (numbers[i] ?? "")).join("");
}

// Height of the lowest point of the parts that can touch something: coim.envs.simulation.lowest_point.
function lowestPoint(mujoco, model, data) {
  mujoco.mj_kinematics(model, data);
  const { geom_type: type, geom_size: size, geom_bodyid: body, geom_contype: con, geom_conaffinity: aff } = model;
  const place = data.geom_xpos, turn = data.geom_xmat;
  let lowest = Infinity;
  for (let i = 0; i < type.length; i++) {
    if (body[i] === 0 || (con[i] === 0 && aff[i] === 0)) continue;
    const up = [0, 1, 2].map((axis) => Math.abs(turn[9 * i + 6 + axis]));
    const [a, b, c] = [0, 1, 2].map((axis) => size[3 * i + axis]);
    const reach = {
      [SPHERE]: a,
      [CAPSULE]: a + b * up[2],
      [CYLINDER]: b * up[2] + a * Math.sqrt(Math.max(1 - up[2] ** 2, 0)),
      [BOX]: a * up[0] + b * up[1] + c * up[2],
      [ELLIPSOID]: Math.hypot(a * up[0], b * up[1], c * up[2]),
    }[type[i]];
    lowest = Math.min(lowest, place[3 * i + 2] - reach);
  }
  return lowest;
}

// Capsules that draw a part in its own axes: coim.envs.rods.rods.
function rods(type, size) {
  if (type === SPHERE || type === CAPSULE) {
    const half = type === CAPSULE ? size[1] : 0;
    return [[0, 0, -half, 0, 0, half, size[0]]];
  }
  const sides = type === CYLINDER ? [size[0], size[0], size[1]] : size;
  const [along, across, thin] = [0, 1, 2].sort((one, other) => sides[other] - sides[one]);
  const radius = Math.max(sides[thin], sides[across] / FLATTEST), reach = sides[across] - radius;
  const steps = Math.ceil(reach / (OVERLAP * radius) - 1e-9);
  const places = [0];
  for (let k = 1; k <= steps; k++) places.push((-reach * k) / steps, (reach * k) / steps);
  const round = type === ELLIPSOID || (type === CYLINDER && thin === 2);
  return places.map((place) => {
    const length = sides[along] * (round ? Math.sqrt(1 - (place / sides[across]) ** 2) : 1);
    const rod = [0, 0, 0, 0, 0, 0, radius];
    rod[3 + along] = Math.max(length - radius, 0);
    rod[along] = -rod[3 + along];
    rod[across] = rod[3 + across] = place;
    return rod;
  });
}

// Those of one part of a model; a mesh is the box around it.
function rodsOf(model, i) {
  if (model.geom_type[i] !== MESH) return rods(model.geom_type[i], [...model.geom_size.slice(3 * i, 3 * i + 3)]);
  const box = [...model.geom_aabb.slice(6 * i, 6 * i + 6)];
  return rods(BOX, box.slice(3)).map((rod) => rod.map((value, at) => (at < 6 ? value + box[at % 3] : value)));
}

// A body that is simulated: any design, driven by a policy.
class Simulation {
  constructor(mujoco, body, policy, design) {
    Object.assign(this, { mujoco, body, policy, steps: 0, seconds: body.step_seconds });
    this.build(design);
    this.reset();
  }

  compiled(design) {
    const compile = (start) => {
      const model = this.mujoco.MjModel.from_xml_string(filled(this.body, design, start));
      return [model, new this.mujoco.MjData(model)];
    };
    if (this.body.clearance === null) return compile(0);
    const [flat, pose] = compile(0);
    // As coim.envs.simulation.start_clearance: some joints start beyond their ranges.
    for (const [at, low, high] of this.body.ranges) pose.qpos[at] = Math.min(Math.max(pose.qpos[at], low), high);
    const clearance = [1, ...design].reduce((sum, value, i) => sum + value * this.body.clearance[i], 0);
    const start = clearance - lowestPoint(this.mujoco, flat, pose);
    flat.delete();
    pose.delete();
    return compile(start);
  }

  // Take another body in the present pose: it keeps its clearance, as MorphEnv.transfer.
  build(design) {
    const [model, data] = this.compiled(design);
    if (this.model) {
      const rise = lowestPoint(this.mujoco, this.model, this.data);
      data.qpos.set(this.data.qpos);
      data.qvel.set(this.data.qvel);
      if (this.body.height !== null) data.qpos[this.body.height] += rise - lowestPoint(this.mujoco, model, data);
      this.model.delete();
      this.data.delete();
    }
    const shown = [...model.geom_type.keys()]
      .filter((i) => model.geom_bodyid[i] > 0 && [SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH].includes(model.geom_type[i]))
      .flatMap((i) => rodsOf(model, i).map((rod) => ({ i, rod })));
    const range = model.actuator_ctrlrange;
    const motors = Array.from({ length: model.nu }, (_, i) => [range[2 * i], range[2 * i + 1]]);
    Object.assign(this, { model, data, design, shown, motors });
    this.mujoco.mj_kinematics(model, data);
  }

  reset() {
    this.mujoco.mj_resetData(this.model, this.data);
    this.mujoco.mj_kinematics(this.model, this.data);
    this.steps = 0;
  }

  observation() {
    const positions = [...this.data.qpos].slice(this.body.first_position);
    for (const i of this.body.angles) positions[i] -= TURN * Math.ceil(positions[i] / TURN - 0.5);
    return [...positions, ...this.data.qvel];
  }

  step() {
    const action = this.policy.act(this.observation(), this.design);
    action.forEach((share, i) => {
      const [low, high] = this.motors[i];
      this.data.ctrl[i] = (low + high) / 2 + (share * (high - low)) / 2;
    });
    for (let i = 0; i < this.body.frame_skip; i++) this.mujoco.mj_step(this.model, this.data);
    this.steps += 1;
    if (![...this.data.qpos, ...this.data.qvel].every((value) => Math.abs(value) < BEYOND_PHYSICS)) this.reset();
  }

  capsules() {
    const { geom_xpos: place, geom_xmat: turn } = this.data;
    return this.shown.map(({ i, rod }) => {
      const moved = (at) => [0, 1, 2].map((axis) => [0, 1, 2].reduce((sum, own) => sum + turn[9 * i + 3 * axis + own] * rod[at + own], place[3 * i + axis]));
      return [...moved(0), ...moved(3), rod[6]];
    });
  }
}

// A walk that was recorded.
class Recording {
  constructor(walk, outline, seconds) {
    Object.assign(this, { frames: floats(walk.frames), count: walk.num_frames, outline, seconds });
    this.reset();
  }

  reset() {
    this.steps = 0;
  }

  step() {
    this.steps = (this.steps + 1) % this.count; // and again from its start
  }

  capsules() {
    const size = 6 * this.outline.length;
    return this.outline.map((capsule, i) => {
      const at = this.steps * size + 6 * i;
      return [...this.frames.subarray(at, at + 6), capsule[6]];
    });
  }
}
