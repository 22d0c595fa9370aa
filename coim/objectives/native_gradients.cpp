// The gradients of gradients.py and dynamics_gradients.py for one network (or one policy with its critics) on a CPU, in one
// call, up to rounding; or whole updates by Adam. Compiled by coim/native.py and called by native_gradients.py, whose structures
// are those of here, of native_networks.h and of native_adam.h.
//
// Shapes: B batch, S observation, D design, A action, F inputs of a layer.

#include "native_networks.h"

#include <numeric>

// ---- Eq. 7-8 of one policy and its critics.

struct Sac {
  Team team;
  int64_t threads;
  int64_t batch, observed, designed, acted;     // B, S, D, A
  int64_t critics, policy_layers, critic_layers;
  const Layer *policy, *critic, *target;        // [policy_layers], [critics, critic_layers] twice
  const void *observation, *design, *action, *next_observation, *reward;  // [B, ...], as are the next four
  const bool* terminated;
  const void *noise, *next_noise, *weight;
  double alpha, gamma, least, most;             // temperature, discount, range of the log-scale
  void* losses;                                 // [3]: of the actor, of the critics, entropy
  void* scratch;                                // as many numbers as the function returns without it
};

namespace {

// All entries of all actions of a block of rows, one after the other.
template <class T>
struct Entries {
  T *loc, *log_scale, *scale, *action, *density;
};

// What one worker needs for a block of rows.
template <class T>
struct Desk {
  Trace<T> next_policy, target;
  std::vector<Trace<T>> fresh;  // critics at the policy's own actions
  Matrix<T> of_action;          // [rows, A]
  Entries<T> entries;
};

template <class T>
int64_t sac(const Sac& s, const Step<T>* step = nullptr) {
  Room<T> room{static_cast<T*>(s.scratch)};
  const int64_t block = block_of(s.batch, s.threads, BLOCK), blocks = (s.batch + block - 1) / block;
  const Weights<T> weights{s.batch, block, s.threads, s.team, step};
  Packing<T> policy = packing(room, s.policy, s.policy_layers, true);
  std::vector<Packing<T>> critics, targets;
  std::vector<Trace<T>> stored;
  Trace<T> own = trace(room, weights.rows(), s.policy, s.policy_layers, true);
  for (int64_t n = 0; n < s.critics; ++n) {
    const Layer *critic = s.critic + n * s.critic_layers, *target = s.target + n * s.critic_layers;
    critics.push_back(packing(room, critic, s.critic_layers, true, s.observed, s.acted));
    targets.push_back(packing(room, target, s.critic_layers, false));
    stored.push_back(trace(room, weights.rows(), critic, s.critic_layers, true));
    if (n > 0) stored[n].values[0] = stored[0].values[0];  // all critics see the same rows
  }
  std::vector<Desk<T>> desks;
  for (int64_t worker = 0; worker < std::max(int64_t(1), s.threads); ++worker) {
    Desk<T> desk;
    desk.next_policy = trace(room, block, s.policy, s.policy_layers, false);
    desk.target = trace(room, block, s.critic, s.critic_layers, false);
    for (int64_t n = 0; n < s.critics; ++n) desk.fresh.push_back(trace(room, block, s.critic, s.critic_layers, true));
    const int64_t entries = block * s.acted + LANES<T>;
    auto& [loc, log_scale, scale, action, density] = desk.entries;
    for (T** part : {&loc, &log_scale, &scale, &action, &density}) *part = room.numbers(entries);
    desk.of_action = room.matrix(block, s.acted);
    desks.push_back(desk);
  }
  T* losses = room.numbers(3 * s.batch);
  if (s.scratch == nullptr) return room.used;

  std::vector<const Packed<T>*> layers;
  for (const auto* networks : {&critics, &targets}) {
    for (const Packing<T>& network : *networks) {
      for (const Packed<T>& layer : network) layers.push_back(&layer);
    }
  }
  for (const Packed<T>& layer : policy) layers.push_back(&layer);
  spread(s.team, s.threads, layers.size(), [&](int64_t task, int64_t) { layers[task]->pack(); });

  const auto* observation = static_cast<const T*>(s.observation);
  const auto* next_observation = static_cast<const T*>(s.next_observation);
  const auto* design = static_cast<const T*>(s.design);
  const auto* action = static_cast<const T*>(s.action);
  const auto* reward = static_cast<const T*>(s.reward);
  const auto* noise = static_cast<const T*>(s.noise);
  const auto* next_noise = static_cast<const T*>(s.next_noise);
  const auto* weight = static_cast<const T*>(s.weight);
  const T alpha = s.alpha, gamma = s.gamma, least = s.least, most = s.most;
  const int64_t S = s.observed, D = s.designed, A = s.acted;

  // Actions and their log-densities: `tanh_normal` of functional.py, from the output of the policy, loc and log-scale. All
  // entries of the rows lie one after the other, so that few lanes of a vector are without work.
  const auto act = [&](const Desk<T>& desk, const Matrix<T>& output, const T* epsilon, int64_t rows, auto take) {
    const auto& [loc, log_scale, scale, to, density] = desk.entries;
    for (int64_t i = 0; i < rows; ++i) {
      copy_row<T>(loc + i * A, {{output.row(i), A}});
      copy_row<T>(log_scale + i * A, {{output.row(i) + A, A}});
    }
    for (int64_t at = 0; at < rows * A; at += LANES<T>) {
      Vector<T> noise{};
      std::memcpy(&noise, epsilon + at, std::min(LANES<T>, rows * A - at) * sizeof(T));
      const Vector<T> raw = load(log_scale + at), low = Vector<T>{} + least, high = Vector<T>{} + most;
      const Vector<T> within = raw < low ? low : raw > high ? high : raw, deviation = exponential<T>(within);
      const Vector<T> preimage = load(loc + at) + deviation * noise;
      const Vector<T> size = preimage < T(0) ? -preimage : preimage, bend = exponential<T>(T(-2) * size);
      const Vector<T> tanh = (T(1) - bend) / (T(1) + bend);
      const Vector<T> log_normal = -noise * noise * T(0.5) - within - T(0.91893853320467274178);             // log(2 pi) / 2
      const Vector<T> log_slope = T(2) * (T(0.69314718055994530942) - size - log_of_one_and<T>(bend));  // log 2
      store(scale + at, deviation);
      store(to + at, preimage < T(0) ? -tanh : tanh);
      store(density + at, log_normal - log_slope);
    }
    for (int64_t i = 0; i < rows; ++i) {
      T log_prob = 0;
      for (int64_t a = 0; a < A; ++a) log_prob += density[i * A + a];
      take(i, to + i * A, log_prob);
    }
  };
  const auto lesser = [](T x, T y) { return x < y || x != x ? x : y; };  // NaN wins, as in torch

  spread(s.team, s.threads, blocks, [&](int64_t task, int64_t worker) {
    const int64_t from = task * block, rows = std::min(block, s.batch - from);
    const Desk<T>& desk = desks[worker];
    const Trace<T> mine = own.from(weights.place(from));
    std::vector<Trace<T>> now;
    for (const Trace<T>& trace : stored) now.push_back(trace.from(weights.place(from)));
    T *loss_actor = losses + from, *loss_qvalue = loss_actor + s.batch, *log_probs = loss_qvalue + s.batch;

    for (int64_t i = 0; i < rows; ++i) {
      const int64_t r = from + i;
      copy_row<T>(mine.values[0].row(i), {{observation + r * S, S}, {design + r * D, D}});
      copy_row<T>(desk.next_policy.values[0].row(i), {{next_observation + r * S, S}, {design + r * D, D}});
    }
    forward<T>(policy, rows, mine);
    forward<T>(policy, rows, desk.next_policy);
    act(desk, desk.next_policy.values.back(), next_noise + from * A, rows, [&](int64_t i, const T* to, T log_prob) {
      const int64_t r = from + i;
      copy_row<T>(desk.target.values[0].row(i), {{next_observation + r * S, S}, {to, A}, {design + r * D, D}});
      loss_qvalue[i] = log_prob;  // until the target is known
    });
    act(desk, mine.values.back(), noise + from * A, rows, [&](int64_t i, const T* to, T log_prob) {
      const int64_t r = from + i;
      copy_row<T>(desk.fresh[0].values[0].row(i), {{observation + r * S, S}, {to, A}, {design + r * D, D}});
      copy_row<T>(now[0].values[0].row(i), {{observation + r * S, S}, {action + r * A, A}, {design + r * D, D}});
      log_probs[i] = log_prob;
    });

    // Eq. 3. `loss_actor` holds the least target critic, then the target.
    for (int64_t n = 0; n < s.critics; ++n) {
      forward<T>(targets[n], rows, desk.target);
      for (int64_t i = 0; i < rows; ++i) {
        const T q = desk.target.values.back().row(i)[0];
        loss_actor[i] = n == 0 ? q : lesser(q, loss_actor[i]);
      }
    }
    for (int64_t i = 0; i < rows; ++i) {
      const int64_t r = from + i;
      const T value = loss_actor[i] - alpha * loss_qvalue[i];
      loss_actor[i] = reward[r] + gamma * (s.terminated[r] ? T(0) : value);
      loss_qvalue[i] = 0;
    }
    for (int64_t n = 0; n < s.critics; ++n) {
      Trace<T> fresh = desk.fresh[n];
      fresh.values[0] = desk.fresh[0].values[0];
      forward<T>(critics[n], rows, now[n]);
      forward<T>(critics[n], rows, fresh);
      for (int64_t i = 0; i < rows; ++i) {
        const T error = now[n].values.back().row(i)[0] - loss_actor[i];
        loss_qvalue[i] += error * error / 2 * weight[from + i];
        now[n].deltas.back().row(i)[0] = error * weight[from + i];
      }
      backward<T>(critics[n], rows, now[n]);
      weights.of_block(critics[n], now[n], from, rows);
    }

    // Eq. 4: the smallest critic gets the gradient, equal ones share it.
    for (int64_t i = 0; i < rows; ++i) {
      T least_q = desk.fresh[0].values.back().row(i)[0], equal = 0;
      for (int64_t n = 1; n < s.critics; ++n) least_q = lesser(desk.fresh[n].values.back().row(i)[0], least_q);
      for (int64_t n = 0; n < s.critics; ++n) equal += desk.fresh[n].values.back().row(i)[0] == least_q;
      for (int64_t n = 0; n < s.critics; ++n) {
        const T smallest = desk.fresh[n].values.back().row(i)[0] == least_q;
        desk.fresh[n].deltas.back().row(i)[0] = -weight[from + i] * (smallest / equal);
      }
      loss_actor[i] = (alpha * log_probs[i] - least_q) * weight[from + i];
    }
    for (int64_t n = 0; n < s.critics; ++n) {
      backward<T>(critics[n], rows, desk.fresh[n]);
      const Matrix<T> delta = desk.fresh[n].deltas[0];
      const Packed<T>& layer = critics[n][0];
      Product<T> product{rows, A, layer.outputs, delta.data, delta.stride, 1, layer.backward, layer.outputs, PANEL<T>, desk.of_action};
      product.adds = n > 0;
      product.compute();
    }

    // Through the tanh, as in gradients.py.
    for (int64_t i = 0; i < rows; ++i) {
      const int64_t r = from + i;
      const T entropy_weight = alpha * weight[r];
      const T *log_scale = mine.values.back().row(i) + A, *of = desk.of_action.row(i);
      const T *to = desk.entries.action + i * A, *deviation = desk.entries.scale + i * A;  // `act` left them there
      T* delta = mine.deltas.back().row(i);
      for (int64_t a = 0; a < A; ++a) {
        const T raw = log_scale[a];
        const T of_preimage = of[a] * (1 - to[a] * to[a]) + 2 * entropy_weight * to[a];
        delta[a] = of_preimage;
        // not skipped where it is zero, but multiplied: NaN stays
        delta[A + a] = (of_preimage * deviation[a] * noise[r * A + a] - entropy_weight) * T(raw >= least && raw <= most);
      }
    }
    backward<T>(policy, rows, mine);
    weights.of_block(policy, mine, from, rows);
  });

  std::vector<std::pair<const Packing<T>*, const Trace<T>*>> networks{{&policy, &own}};
  for (int64_t n = 0; n < s.critics; ++n) networks.push_back({&critics[n], &stored[n]});
  weights.of_all(networks);

  double sums[3] = {0, 0, 0};
  for (int64_t loss = 0; loss < 3; ++loss) {
    for (int64_t r = 0; r < s.batch; ++r) sums[loss] += losses[loss * s.batch + r];
  }
  T* found = static_cast<T*>(s.losses);
  found[0] = T(sums[0]), found[1] = T(sums[1]), found[2] = T(-sums[2] / s.batch);
  return room.used;
}

}  // namespace

// ---- Eq. 6 of one member of an ensemble.

struct Dynamics {
  Team team;
  int64_t threads;
  int64_t batch, layers;
  const Layer* layer;
  const void *x, *target;  // [B, F], [B, S]
  double low, high;        // soft bounds of the log-variance
  void* loss;              // [1]
  void* scratch;           // as above
};

namespace {

template <class T>
Vector<T> softplus(Vector<T> x) {
  const Vector<T> size = x < T(0) ? -x : x;
  return x > T(20) ? x : (x < T(0) ? Vector<T>{} : x) + log_of_one_and<T>(exponential<T>(-size));  // 20: as torch has it
}

// All entries of a block of rows, one after the other: mean and unbounded log-variance, then their gradients; the losses.
template <class T>
struct Moments {
  T *mean, *raw, *loss;
};

template <class T>
int64_t dynamics(const Dynamics& d, const Step<T>* step = nullptr) {
  Room<T> room{static_cast<T*>(d.scratch)};
  bool wide = false;
  for (int64_t l = 0; l < d.layers; ++l) wide = wide || d.layer[l].inputs * d.layer[l].outputs > WIDE;
  const int64_t block = block_of(d.batch, d.threads, wide ? 2 * BLOCK : BLOCK), blocks = (d.batch + block - 1) / block;
  const Packing<T> network = packing(room, d.layer, d.layers, true);
  const Weights<T> weights{d.batch, block, d.threads, d.team, step};
  const Trace<T> all = trace(room, weights.rows(), d.layer, d.layers, true, true);
  const int64_t F = network.front().inputs, S = network.back().outputs / 2;
  std::vector<Moments<T>> desks;
  for (int64_t worker = 0; worker < std::max(int64_t(1), d.threads); ++worker) {
    const int64_t entries = block * S;
    desks.push_back({room.numbers(entries), room.numbers(entries), room.numbers(entries)});
  }
  T* losses = room.numbers(d.batch);
  if (d.scratch == nullptr) return room.used;
  spread(d.team, d.threads, network.size(), [&](int64_t task, int64_t) { network[task].pack(); });

  const T low = d.low, high = d.high, share = T(1) / d.batch;
  spread(d.team, d.threads, blocks, [&](int64_t task, int64_t worker) {
    const int64_t from = task * block, rows = std::min(block, d.batch - from);
    const Trace<T> mine = all.from(weights.place(from));
    for (int64_t i = 0; i < rows; ++i) std::copy_n(static_cast<const T*>(d.x) + (from + i) * F, F, mine.values[0].row(i));
    forward<T>(network, rows, mine);
    const auto [mean, raw, loss] = desks[worker];
    const T* target = static_cast<const T*>(d.target) + from * S;
    for (int64_t i = 0; i < rows; ++i) {
      const T* out = mine.values.back().row(i);
      copy_row<T>(mean + i * S, {{out, S}});
      copy_row<T>(raw + i * S, {{out + S, S}});
    }
    for (int64_t at = 0; at < rows * S; at += LANES<T>) {  // `_output_gradient` of dynamics_gradients.py
      Vector<T> wanted{};
      std::memcpy(&wanted, target + at, std::min(LANES<T>, rows * S - at) * sizeof(T));
      const Vector<T> above = high - load(raw + at), below = high - softplus<T>(above) - low;
      const Vector<T> log_var = low + softplus<T>(below), precision = exponential<T>(-log_var);
      const Vector<T> error = load(mean + at) - wanted, square = error * error * precision;
      const Vector<T> slope = sigmoid<T>(above) * sigmoid<T>(below);  // of log_var over raw
      store(mean + at, T(2) * share * error * precision);
      store(raw + at, share * (T(1) - square) * slope);
      store(loss + at, square + log_var);
    }
    for (int64_t i = 0; i < rows; ++i) {
      copy_row<T>(mine.deltas.back().row(i), {{mean + i * S, S}, {raw + i * S, S}});
      losses[from + i] = std::accumulate(loss + i * S, loss + (i + 1) * S, T(0));
    }
    backward<T>(network, rows, mine);
    weights.of_block(network, mine, from, rows);
  });

  weights.of_all({{&network, &all}});
  double sum = 0;
  for (int64_t r = 0; r < d.batch; ++r) sum += losses[r];
  *static_cast<T*>(d.loss) = T(sum / d.batch);
  return room.used;
}

}  // namespace

// ---- Updates, with rows [updates, runs, B, ...] of which the structures have the first ones.

namespace {

template <class T>
int64_t sac_updates(const Sac* runs, int64_t num_runs, int64_t updates, const Adam& all, T* scratch) {
  return updates_of<T>(runs, num_runs, updates, all, scratch, [&](Sac s, int64_t u, const Step<T>* step) {
    const int64_t rows = u * num_runs * s.batch;
    const auto move = [&](const void*& part, int64_t width) { part = static_cast<const T*>(part) + rows * width; };
    for (const void** part : {&s.observation, &s.next_observation}) move(*part, s.observed);
    for (const void** part : {&s.action, &s.noise, &s.next_noise}) move(*part, s.acted);
    for (const void** part : {&s.reward, &s.weight}) move(*part, 1);
    move(s.design, s.designed);
    s.terminated += rows;
    s.losses = static_cast<T*>(s.losses) + 3 * num_runs * u;
    return sac<T>(s, step);
  });
}

// The members of all runs, one run after the other; those of a run have its rows.
template <class T>
int64_t dynamics_updates(const Dynamics* members, int64_t count, int64_t num_runs, int64_t updates, const Adam& all, T* scratch) {
  return updates_of<T>(members, count, updates, all, scratch, [&](Dynamics d, int64_t u, const Step<T>* step) {
    const int64_t rows = u * num_runs * d.batch;
    d.x = static_cast<const T*>(d.x) + rows * d.layer[0].inputs;
    d.target = static_cast<const T*>(d.target) + rows * (d.layer[d.layers - 1].outputs / 2);
    d.loss = static_cast<T*>(d.loss) + count * u;
    return dynamics<T>(d, step);
  });
}

}  // namespace

extern "C" {
int64_t sac_float(const Sac* s) { return sac<float>(*s); }
int64_t dynamics_float(const Dynamics* d) { return dynamics<float>(*d); }
int64_t sac_updates_float(const Sac* runs, int64_t num_runs, int64_t updates, const Adam* all, float* scratch) {
  return sac_updates<float>(runs, num_runs, updates, *all, scratch);
}
int64_t dynamics_updates_float(const Dynamics* members, int64_t count, int64_t num_runs, int64_t updates, const Adam* all, float* scratch) {
  return dynamics_updates<float>(members, count, num_runs, updates, *all, scratch);
}
int64_t sac_double(const Sac* s) { return sac<double>(*s); }
int64_t dynamics_double(const Dynamics* d) { return dynamics<double>(*d); }
int64_t sac_updates_double(const Sac* runs, int64_t num_runs, int64_t updates, const Adam* all, double* scratch) {
  return sac_updates<double>(runs, num_runs, updates, *all, scratch);
}
int64_t dynamics_updates_double(const Dynamics* members, int64_t count, int64_t num_runs, int64_t updates, const Adam* all, double* scratch) {
  return dynamics_updates<double>(members, count, num_runs, updates, *all, scratch);
}
}
