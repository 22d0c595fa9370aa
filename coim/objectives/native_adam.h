// Steps of Adam over flat buffers, with targets that follow the last weights: what native_gradients.cpp does with gradients.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

struct Adam {
  void *weights, *gradient, *first, *second;  // [count]: moments
  void* targets;                              // [followed], of the last weights
  int64_t count, followed;
  double lr, beta1, beta2, eps, decay, tau;
  bool decoupled;                             // AdamW's decay
  double steps;                               // done before
};

namespace {

// One step, a part of the buffers at a time: the part whose gradient was computed last is still in the cache.
template <class T>
class Step {
 public:
  // `number` begins with 1.
  Step(const Adam& all, double number)
      : all(all), step(all.lr / (1 - std::pow(all.beta1, number))), root(std::sqrt(1 - std::pow(all.beta2, number))) {}

  // As torch.optim.Adam and torchrl's SoftUpdate have it, up to rounding, for the weights of these gradients.
  void of(const void* some, int64_t count) const {
    const T* __restrict gradient = static_cast<const T*>(all.gradient);
    T* __restrict weights = static_cast<T*>(all.weights);
    T* __restrict first = static_cast<T*>(all.first);
    T* __restrict second = static_cast<T*>(all.second);
    const T kept = all.decoupled ? 1 - all.lr * all.decay : 1, decay = all.decoupled ? 0 : all.decay;
    const T one = 1 - all.beta1, other = 1 - all.beta2, beta2 = all.beta2, eps = all.eps;
    const T step = this->step, root = this->root;
    const int64_t from = static_cast<const T*>(some) - gradient, to = from + count;
    for (int64_t i = from; i < to; ++i) {
      const T g = gradient[i] + decay * weights[i];
      first[i] += one * (g - first[i]);
      second[i] = beta2 * second[i] + other * g * g;
      weights[i] = kept * weights[i] - step * first[i] / (std::sqrt(second[i]) / root + eps);
    }
    T* __restrict targets = static_cast<T*>(all.targets);
    const T tau = all.tau;
    const int64_t before = all.count - all.followed;
    for (int64_t i = std::max(from, before); i < to; ++i) {  // from the nearer end, as torch.lerp: tau = 1 copies
      const T target = targets[i - before], way = weights[i] - target;
      targets[i - before] = tau < T(0.5) ? target + tau * way : weights[i] - (1 - tau) * way;
    }
  }

 private:
  const Adam& all;
  const T step, root;
};

}  // namespace
