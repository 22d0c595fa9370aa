// An episode of one body under its policy, in one call: what coim/episode.py does step by step, up to rounding.
//
// MuJoCo's mjb_apply calls `act` for every simulation on threads of its own, and catches MuJoCo's errors. Compiled by
// coim/envs/native_episode.py, whose structures are the ones below. Two conditions keep the rows what Python makes of the
// same actions, to the last bit: observations are computed in double and rounded once, and no product is fused with a sum
// but where this file says so.

#include <algorithm>
#include <cmath>
#include <cstdint>

#include <mujoco/mjdata.h>
#include <mujoco/mjmodel.h>

// A fused product and sum where the processor has one; elsewhere std::fma is a slow function.
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
#define MULTIPLY_ADD(a, b, c) std::fma(a, b, c)
#else
#define MULTIPLY_ADD(a, b, c) ((a) * (b) + (c))
#endif

struct Layer {
  const float* weight;  // [inputs, outputs] of the first body
  const float* bias;    // [outputs]
  int64_t next_weight;  // from one body's weights to the next one's; 0 if all act by the same policy
  int64_t next_bias;
  int64_t inputs, outputs;
};

struct Episode {
  void (*step)(const mjModel*, mjData*);
  int64_t bodies, steps, substeps;                // K; before which step to stop; steps of MuJoCo in one of ours
  int64_t observed, designed, acted;              // S, D, A
  int64_t unseen, angles, layers, width;          // positions that are not observed; counts; units of the widest layer
  const int64_t* angle;                           // observed entries that are wrapped
  const double *middle, *reach;                   // of each motor's range, or null where it is [-1, 1]
  double beyond;                                  // no position or velocity of a working body is so large
  const Layer* layer;
  const float *scale, *design, *noise;            // [S]; [K, D], as the network reads them; [T, K, A], null for the mode
  float least, most;                              // range of the log-scale
  float *observation, *action, *following, *scratch;  // [T, K, S], [T, K, A], [T, K, S], [K, 2 * width]
  int64_t* next;                                  // [K]: the step that each body takes next
  int64_t* ending;                                // [K]: why it stopped
};

static_assert(sizeof(mjtNum) == sizeof(double), "MuJoCo computes in double here");

enum Ending { WHOLE = 0, BROKEN = 1, NOT_FINITE = 2 };

namespace {

// Positions without the place on the ground, and velocities, with angles in (-pi, pi].
void observe(const mjModel* m, const mjData* d, const Episode& e, float* seen) {
  const double turn = 6.283185307179586;
  const int64_t positions = m->nq - e.unseen;
  for (int64_t i = 0; i < positions; ++i) {
    seen[i] = static_cast<float>(d->qpos[e.unseen + i]);
  }
  for (int64_t i = 0; i < e.angles; ++i) {
    const double angle = d->qpos[e.unseen + e.angle[i]];
    seen[e.angle[i]] = static_cast<float>(angle - turn * std::ceil(angle / turn - 0.5));
  }
  for (int64_t i = 0; i < m->nv; ++i) {
    seen[positions + i] = static_cast<float>(d->qvel[i]);
  }
}

// y = x W + b. The sum goes over the inputs, so that a processor's vectors hold outputs: no order of a
// sum is left to the compiler. After a ReLU half of the inputs are 0; of the others four are taken at once, since to load
// and store y for each takes longer than the products.
void product(const Layer& layer, int64_t body, const float* x, float* __restrict y) {
  const float* weight = layer.weight + body * layer.next_weight;
  const float* bias = layer.bias + body * layer.next_bias;
  const int64_t outputs = layer.outputs;
  const float* rows[4];
  float factors[4];
  int taken = 0;
  std::copy(bias, bias + outputs, y);
  for (int64_t i = 0; i < layer.inputs; ++i) {
    if (x[i] == 0) continue;
    rows[taken] = weight + i * outputs;
    factors[taken] = x[i];
    if (++taken < 4) continue;
    taken = 0;
    const float *__restrict r0 = rows[0], *__restrict r1 = rows[1], *__restrict r2 = rows[2], *__restrict r3 = rows[3];
    const float f0 = factors[0], f1 = factors[1], f2 = factors[2], f3 = factors[3];
    for (int64_t j = 0; j < outputs; ++j) {
      const float two = MULTIPLY_ADD(f1, r1[j], MULTIPLY_ADD(f0, r0[j], y[j]));
      y[j] = MULTIPLY_ADD(f3, r3[j], MULTIPLY_ADD(f2, r2[j], two));
    }
  }
  for (int i = 0; i < taken; ++i) {
    const float* __restrict row = rows[i];
    const float factor = factors[i];
    for (int64_t j = 0; j < outputs; ++j) y[j] = MULTIPLY_ADD(factor, row[j], y[j]);
  }
}

// The action of a tanh-Gaussian policy: its mode, or a sample of it.
void decide(const Episode& e, int64_t body, const float* seen, const float* noise, float* action) {
  float *x = e.scratch + 2 * body * e.width, *y = x + e.width;
  for (int64_t i = 0; i < e.observed; ++i) x[i] = seen[i] / e.scale[i];
  std::copy(e.design + body * e.designed, e.design + (body + 1) * e.designed, x + e.observed);
  for (int64_t i = 0; i < e.layers; ++i) {
    product(e.layer[i], body, x, y);
    if (i + 1 < e.layers) {
      for (int64_t j = 0; j < e.layer[i].outputs; ++j) y[j] = y[j] < 0 ? 0 : y[j];
    }
    std::swap(x, y);
  }
  for (int64_t i = 0; i < e.acted; ++i) {
    float before_tanh = x[i];
    if (noise) {
      const float log_scale = std::min(std::max(x[e.acted + i], e.least), e.most);
      before_tanh += std::exp(log_scale) * noise[i];
    }
    action[i] = std::tanh(before_tanh);
  }
}

bool within(const double* values, int64_t count, double beyond) {
  for (int64_t i = 0; i < count; ++i) {
    if (!(std::abs(values[i]) < beyond)) return false;  // NaN is not
  }
  return true;
}

}  // namespace

extern "C" void act(const mjModel* m, mjData* d, int body, void* argument) {
  const Episode& e = *static_cast<const Episode*>(argument);
  // From zero, since MuJoCo, when it puts a body back by itself, sets the counter to 1, whatever it was.
  for (int i = 0; i < mjNWARNING; ++i) d->warning[i].number = 0;
  for (int64_t t = e.next[body]; t < e.steps; ++t) {
    e.next[body] = t;  // an error of MuJoCo leaves from within the step
    const int64_t row = t * e.bodies + body;
    float *seen = e.observation + row * e.observed, *action = e.action + row * e.acted;
    float* following = e.following + row * e.observed;
    observe(m, d, e, seen);
    decide(e, body, seen, e.noise ? e.noise + row * e.acted : nullptr, action);
    for (int64_t i = 0; i < e.acted; ++i) {
      if (!std::isfinite(action[i])) {
        e.ending[body] = NOT_FINITE;
        return;
      }
      const double torque = action[i];
      d->ctrl[i] = e.reach ? e.middle[i] + e.reach[i] * torque : torque;
    }
    for (int64_t i = 0; i < e.substeps; ++i) e.step(m, d);
    bool works = within(d->qpos, m->nq, e.beyond) && within(d->qvel, m->nv, e.beyond);
    for (int i = 0; i < mjNWARNING; ++i) works = works && d->warning[i].number == 0;
    e.next[body] = t + 1;
    if (!works) {
      std::copy(seen, seen + e.observed, following);  // the last that is finite
      e.ending[body] = BROKEN;
      return;
    }
    observe(m, d, e, following);
  }
}
