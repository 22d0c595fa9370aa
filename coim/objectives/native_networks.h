// Feed-forward networks on a CPU, forwards and backwards: what native_gradients.cpp computes the equations with.
//
// Rows of a batch do not depend on each other but in the sums over them: a block of rows goes through all networks and back
// while it is in the cache. The sums over rows, which are the gradients of the weights, are taken in one order, whatever
// the number of threads: see `Weights`.
//
// Shapes: B batch, F inputs of a layer, O its outputs.

#pragma once

#include "native_adam.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <vector>

namespace {

// ---- Vectors: BYTES wide, TILE_ROWS x 2 of them are all the sums that the registers hold.

#if defined(__AVX512F__)
constexpr int BYTES = 64, TILE_ROWS = 8;
#else
constexpr int BYTES = 32, TILE_ROWS = 6;
#endif
constexpr int64_t BLOCK = 132;  // about so many rows go through the networks together
constexpr int64_t WIDE = 1 << 17;  // of more numbers than this in a layer, twice as many: its gradient leaves the cache
constexpr int64_t DEPTH = 128;  // products that a tile sums at once of a copied panel; of others twice as many
constexpr int64_t LINE = 64;    // bytes of a line of the cache

template <class T>
struct VectorOf {
  typedef T type __attribute__((vector_size(BYTES), aligned(sizeof(T)), may_alias));
};
template <class T>
using Vector = typename VectorOf<T>::type;
template <class T>
constexpr int64_t LANES = BYTES / sizeof(T);

template <class T>
Vector<T> load(const T* at) {
  return *reinterpret_cast<const Vector<T>*>(at);
}

template <class T>
void store(T* at, Vector<T> x) {
  *reinterpret_cast<Vector<T>*>(at) = x;
}

// e^x. In float by the polynomial of Cephes (netlib.org/cephes, expf), to two units in the last place; at least
// the smallest normal float; NaN stays NaN.
template <class T>
Vector<T> exponential(Vector<T> given) {
  Vector<T> x = given;
  if constexpr (std::is_same_v<T, float>) {
    typedef int32_t Whole __attribute__((vector_size(BYTES)));
    constexpr float most = 88.3762626647949f, least = -87.3365447504f;
    x = x > most ? Vector<T>{} + most : x;
    x = x < least ? Vector<T>{} + least : x;
    const Vector<T> magic = Vector<T>{} + 12582912.0f;  // 1.5 * 2^23: adding it rounds to a whole number
    const Vector<T> n = (x * 1.44269504088896341f + magic) - magic;
    const Vector<T> r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
    Vector<T> y = r * 1.9875691500e-4f + 1.3981999507e-3f;
    y = y * r + 8.3334519073e-3f;
    y = y * r + 4.1665795894e-2f;
    y = y * r + 1.6666665459e-1f;
    y = y * r + 5.0000001201e-1f;
    y = y * (r * r) + r + 1.0f;
    const Whole power = (__builtin_convertvector(n, Whole) + 127) << 23;
    y *= reinterpret_cast<const Vector<T>&>(power);
    return given > most ? Vector<T>{} + INFINITY : y;
  } else {
    for (int64_t i = 0; i < LANES<T>; ++i) x[i] = std::exp(x[i]);
    return x;
  }
}

// log(1 + x) for x in [0, 1], to a rounding of 1 + x. In float by the polynomial of Cephes (logf).
template <class T>
Vector<T> log_of_one_and(Vector<T> x) {
  if constexpr (std::is_same_v<T, float>) {
    const Vector<T> one = x + 1.0f, half = one * 0.5f - 1.0f;
    const Vector<T> z = one > 1.41421356f ? half : one - 1.0f;
    Vector<T> y = z * 7.0376836292e-2f - 1.1514610310e-1f;
    y = y * z + 1.1676998740e-1f;
    y = y * z - 1.2420140846e-1f;
    y = y * z + 1.4249322787e-1f;
    y = y * z - 1.6668057665e-1f;
    y = y * z + 2.0000714765e-1f;
    y = y * z - 2.4999993993e-1f;
    y = y * z + 3.3333331174e-1f;
    y = z + z * z * (y * z - 0.5f);
    return one > 1.41421356f ? y + 0.693147180559945f : y;
  } else {
    for (int64_t i = 0; i < LANES<T>; ++i) x[i] = std::log1p(x[i]);
    return x;
  }
}

template <class T>
Vector<T> sigmoid(Vector<T> x) {
  return T(1) / (T(1) + exponential<T>(-x));
}

// ---- Matrices whose rows are padded: to whole vectors, and to an odd number of lines, so that rows do not share a set of
// the cache. What lies in the padding is zero or of no meaning, and never read as data.

template <class T>
struct Matrix {
  T* data;
  int64_t stride;
  T* row(int64_t i) const { return data + i * stride; }
};

// The right-hand side of a product in panels of as many columns as a tile has, one after the other: read in a row.
template <class T>
constexpr int64_t PANEL = 2 * LANES<T>;
template <class T>
int64_t whole_panels(int64_t columns) {
  return (columns + PANEL<T> - 1) / PANEL<T> * PANEL<T>;
}

// Where matrices lie, one after the other; without memory it only counts.
template <class T>
struct Room {
  T* start;
  int64_t used = 0;
  T* numbers(int64_t count) {
    T* at = start == nullptr ? nullptr : start + used;
    const int64_t line = LINE / sizeof(T);
    used += (count + line - 1) / line * line;
    return at;
  }
  Matrix<T> matrix(int64_t rows, int64_t columns) {
    const int64_t line = LINE / sizeof(T);
    const int64_t lines = (columns + line - 1) / line;
    const int64_t stride = (lines + 1 - lines % 2) * line;
    return {numbers(rows * stride), stride};
  }
};

// ---- Products.

enum class End { PLAIN, RELU, SILU, RELU_BACKWARD, SILU_BACKWARD };

// C(i, j) = sum over k of A(i, k) B(k, j), which begins with zero, with a bias or with what stands in C, and goes through a
// function in the end. The choices are made in the code that runs, and not one code for each: compiling takes its time.
template <class T>
struct Product {
  int64_t rows, columns, depth;
  const T* a;
  int64_t row, column;  // A(i, k) lies at a[i * row + k * column]
  const T* b;           // a panel that begins at column j lies at b[j * panel], its rows are b_row apart, whole vectors can be
  int64_t panel, b_row; // read; in `tile` it is the one that is read
  Matrix<T> c;
  const T* bias = nullptr;  // what the sums begin with, if not with zero
  bool adds = false;    // or they begin with C
  End end = End::PLAIN;
  Matrix<T> other{};    // SILU writes its slopes there; the backward functions read the values or slopes of the way forward
  bool narrow = false;  // whether C has no padding

  template <int ROWS, int VECTORS>
  void tile(int64_t i, int64_t j) const {
    Vector<T> sums[ROWS][VECTORS];  // in registers: all loops over them are unrolled
    const bool whole = !narrow || j + VECTORS * LANES<T> <= columns;
    Vector<T> own[ROWS][VECTORS];  // in memory: of a C that has no room for it
    if (adds && !whole) {
      for (int r = 0; r < ROWS; ++r) std::memcpy(own[r], c.row(i + r) + j, (columns - j) * sizeof(T));
    }
    static constexpr T ZEROS[PANEL<T>] = {};
    const T* begin = bias == nullptr ? ZEROS : bias + j;
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; ++r) {
      const T* start = !adds ? begin : whole ? c.row(i + r) + j : reinterpret_cast<const T*>(own[r]);
#pragma GCC unroll 2
      for (int v = 0; v < VECTORS; ++v) sums[r][v] = load(start + v * LANES<T>);
    }
    const T* left = a + i * row;
    const T* right = b;
    for (int64_t k = 0; k < depth; ++k, left += column, right += b_row) {
      Vector<T> y[VECTORS];
#pragma GCC unroll 2
      for (int v = 0; v < VECTORS; ++v) y[v] = load(right + v * LANES<T>);
#pragma GCC unroll 8
      for (int r = 0; r < ROWS; ++r) {
#pragma GCC unroll 2
        for (int v = 0; v < VECTORS; ++v) sums[r][v] += left[r * row] * y[v];
      }
    }
    if (end == End::RELU) {
#pragma GCC unroll 8
      for (int r = 0; r < ROWS; ++r) {
#pragma GCC unroll 2
        for (int v = 0; v < VECTORS; ++v) sums[r][v] = sums[r][v] < T(0) ? Vector<T>{} : sums[r][v];  // NaN stays
      }
    } else if (end == End::RELU_BACKWARD) {
#pragma GCC unroll 8
      for (int r = 0; r < ROWS; ++r) {
#pragma GCC unroll 2
        for (int v = 0; v < VECTORS; ++v) {
          sums[r][v] = load(other.row(i + r) + j + v * LANES<T>) <= T(0) ? Vector<T>{} : sums[r][v];
        }
      }
    } else if (end == End::SILU_BACKWARD) {
#pragma GCC unroll 8
      for (int r = 0; r < ROWS; ++r) {
#pragma GCC unroll 2
        for (int v = 0; v < VECTORS; ++v) sums[r][v] *= load(other.row(i + r) + j + v * LANES<T>);
      }
    }
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; ++r) {
      T* to = whole ? c.row(i + r) + j : reinterpret_cast<T*>(own[r]);
#pragma GCC unroll 2
      for (int v = 0; v < VECTORS; ++v) store(to + v * LANES<T>, sums[r][v]);
    }
    if (!whole) {
      for (int r = 0; r < ROWS; ++r) std::memcpy(c.row(i + r) + j, own[r], (columns - j) * sizeof(T));
    }
    if (end == End::SILU) through_silu(i, j, ROWS, VECTORS);
  }

  // In place, once the sums stand in C: beside an exponential of each number that costs little. The slope is kept for the way
  // back, which needs no exponential then.
  void through_silu(int64_t i, int64_t j, int height, int vectors) const {
    for (int r = 0; r < height; ++r) {
      for (int v = 0; v < vectors; ++v) {
        T* at = c.row(i + r) + j + v * LANES<T>;
        const Vector<T> x = load(at), s = sigmoid<T>(x);
        store(at, x * s);
        store(other.row(i + r) + j + v * LANES<T>, s * (T(1) + x * (T(1) - s)));
      }
    }
  }

  template <int VECTORS>
  void strip(int64_t j) const {
    int64_t i = 0;
    for (; i + TILE_ROWS <= rows; i += TILE_ROWS) tile<TILE_ROWS, VECTORS>(i, j);
    for (; i + 4 <= rows; i += 4) tile<4, VECTORS>(i, j);
    for (; i + 2 <= rows; i += 2) tile<2, VECTORS>(i, j);
    for (; i < rows; ++i) tile<1, VECTORS>(i, j);
  }

  // Sums of many products are taken in parts, whose right-hand sides stay in the first cache. A panel of a right-hand side that
  // lies in longer rows is copied first: so updates of 3 x 200 units took 3 to 5 % less. One that is a single panel as it is
  // needs no copy.
  void compute() const {
    const bool in_panels = b_row == PANEL<T>;
    const int64_t most = in_panels ? 2 * DEPTH : DEPTH;
    alignas(LINE) T copied[DEPTH * PANEL<T>];
    Product part = *this;
    part.b_row = PANEL<T>;
    for (int64_t from = 0; from < depth; from += part.depth) {
      part.depth = std::min(most, depth - from);
      part.a = a + from * column;
      part.adds = adds || from > 0;
      part.end = from + part.depth == depth ? end : End::PLAIN;
      for (int64_t j = 0; j < columns; j += PANEL<T>) {
        const bool whole = j + LANES<T> < columns;
        part.b = b + from * b_row + j * panel;
        if (!in_panels) {
          for (int64_t k = 0; k < part.depth; ++k) {
            const T* right = part.b + k * b_row;
            store(copied + k * PANEL<T>, load(right));
            if (whole) store(copied + k * PANEL<T> + LANES<T>, load(right + LANES<T>));
          }
          part.b = copied;
        }
        whole ? part.template strip<2>(j) : part.template strip<1>(j);
      }
    }
  }
};

// ---- Threads.

using Task = void (*)(void*);
using Team = void (*)(Task, void*, unsigned, unsigned);  // GOMP_parallel, of the OpenMP that torch has loaded

// Call f(task, worker) for every task. Whoever is free takes the next one, which changes no result.
template <class F>
void spread(Team team, int64_t threads, int64_t tasks, F f) {
  if (threads <= 1 || team == nullptr) {
    for (int64_t task = 0; task < tasks; ++task) f(task, int64_t(0));
    return;
  }
  struct Shared {
    F& f;
    int64_t tasks;
    std::atomic<int64_t> task{0}, worker{0};
  } shared{f, tasks};
  team(
      [](void* data) {
        Shared& all = *static_cast<Shared*>(data);
        const int64_t worker = all.worker++;
        for (int64_t task = all.task++; task < all.tasks; task = all.task++) all.f(task, worker);
      },
      &shared, static_cast<unsigned>(threads), 0);
}

// ---- Networks.

struct Layer {
  const void *weight, *bias;               // [F, O], [O]
  void *weight_gradient, *bias_gradient;   // likewise; null for a target
  int64_t inputs, outputs;
};

// One layer, its weights copied to where whole vectors of them can be read.
template <class T>
struct Packed {
  const Layer* layer;
  int64_t inputs, outputs, asked;  // of the inputs, from `first` on, `asked` need a gradient
  int64_t first;
  T *forward, *backward, *bias;    // panels of [F, O]; of [O, asked], or null

  void pack() const {
    const T* weight = static_cast<const T*>(layer->weight);
    for (int64_t from = 0; from < outputs; from += PANEL<T>) {
      const int64_t count = std::min(PANEL<T>, outputs - from);
      T* to = forward + from * inputs;
      for (int64_t f = 0; f < inputs; ++f, to += PANEL<T>) {
        const T* row = weight + f * outputs + from;
        if (count == PANEL<T>) {
          store(to, load(row));
          store(to + LANES<T>, load(row + LANES<T>));
        } else {
          for (int64_t o = 0; o < PANEL<T>; ++o) to[o] = o < count ? row[o] : T(0);
        }
      }
    }
    std::copy_n(static_cast<const T*>(layer->bias), outputs, bias);
    std::fill_n(bias + outputs, whole_panels<T>(outputs) - outputs, T(0));
    for (int64_t from = 0; from < asked; from += PANEL<T>) {
      const int64_t count = std::min(PANEL<T>, asked - from);
      T* to = backward + from * outputs;
      const T* rows = weight + (first + from) * outputs;
      for (int64_t o = 0; o < outputs; o += LANES<T>, to += LANES<T> * PANEL<T>) {  // whole vectors are read
        const int64_t columns = std::min(LANES<T>, outputs - o);
        for (int64_t f = 0; f < count; ++f) {
          for (int64_t i = 0; i < columns; ++i) to[i * PANEL<T> + f] = rows[f * outputs + o + i];
        }
        for (int64_t i = 0; i < columns; ++i) std::fill_n(to + i * PANEL<T> + count, PANEL<T> - count, T(0));
      }
    }
  }
};

template <class T>
using Packing = std::vector<Packed<T>>;

// `first` and `asked`: which inputs of the network need a gradient. Without `backward` none of any layer does.
template <class T>
Packing<T> packing(Room<T>& room, const Layer* layers, int64_t count, bool backward, int64_t first = 0, int64_t asked = 0) {
  Packing<T> network;
  for (int64_t l = 0; l < count; ++l) {
    Packed<T> one{layers + l, layers[l].inputs, layers[l].outputs, 0, 0, nullptr, nullptr, nullptr};
    if (backward) one.asked = l == 0 ? asked : one.inputs;
    if (backward && l == 0) one.first = first;
    one.forward = room.numbers(one.inputs * whole_panels<T>(one.outputs));
    one.bias = room.numbers(whole_panels<T>(one.outputs));
    if (one.asked > 0) one.backward = room.numbers(one.outputs * whole_panels<T>(one.asked));
    network.push_back(one);
  }
  return network;
}

// What a network made of some rows: the input of each layer and the output of the last one; and the gradients of the sums
// that each layer computes. With SiLU its slopes at these sums too.
template <class T>
struct Trace {
  std::vector<Matrix<T>> values, slopes, deltas;

  Trace from(int64_t row) const {
    Trace part = *this;
    for (auto* matrices : {&part.values, &part.slopes, &part.deltas}) {
      for (Matrix<T>& matrix : *matrices) matrix.data = matrix.row(row);
    }
    return part;
  }
};

template <class T>
Trace<T> trace(Room<T>& room, int64_t rows, const Layer* layers, int64_t count, bool deltas, bool silu = false) {
  Trace<T> found;
  for (int64_t l = 0; l < count; ++l) {
    found.values.push_back(room.matrix(rows, layers[l].inputs));
    if (deltas) found.deltas.push_back(room.matrix(rows, layers[l].outputs));
    if (silu && l + 1 < count) found.slopes.push_back(room.matrix(rows, layers[l].outputs));
  }
  found.values.push_back(room.matrix(rows, layers[count - 1].outputs));
  return found;
}

// From the input, ``values[0]``, to the output.
template <class T>
void forward(const Packing<T>& network, int64_t rows, const Trace<T>& trace) {
  for (size_t l = 0; l < network.size(); ++l) {
    const Packed<T>& layer = network[l];
    const Matrix<T> in = trace.values[l];
    Product<T> product{rows, layer.outputs, layer.inputs, in.data, in.stride, 1, layer.forward, layer.inputs, PANEL<T>, trace.values[l + 1], layer.bias};
    if (l + 1 < network.size()) {
      product.end = trace.slopes.empty() ? End::RELU : End::SILU;
      if (!trace.slopes.empty()) product.other = trace.slopes[l];
    }
    product.compute();
  }
}

// From the gradient of the output, the last of ``deltas``, to that of the first layer's sums.
template <class T>
void backward(const Packing<T>& network, int64_t rows, const Trace<T>& trace) {
  for (size_t l = network.size() - 1; l > 0; --l) {
    const Packed<T>& layer = network[l];
    const Matrix<T> in = trace.deltas[l];
    Product<T> product{rows, layer.inputs, layer.outputs, in.data, in.stride, 1, layer.backward, layer.outputs, PANEL<T>, trace.deltas[l - 1]};
    product.end = trace.slopes.empty() ? End::RELU_BACKWARD : End::SILU_BACKWARD;
    product.other = trace.slopes.empty() ? trace.values[l] : trace.slopes[l - 1];
    product.compute();
  }
}

// The size of a block, at most about `most`: as many blocks as there are threads, or a multiple of that.
int64_t block_of(int64_t rows, int64_t threads, int64_t most) {
  const int64_t blocks = threads * ((rows + threads * most - 1) / (threads * most));
  const int64_t size = (rows + blocks - 1) / blocks;
  return (size + TILE_ROWS - 1) / TILE_ROWS * TILE_ROWS;
}

// A part of the weight gradient of a layer: some of its inputs, over all rows; with the first of them that of the bias.
template <class T>
struct Part {
  const Layer* layer;
  Matrix<T> values, deltas;
  int64_t from, to;

  // Of so many rows; `adds` to what others gave. With a step Adam takes it.
  void compute(int64_t rows, bool adds, const Step<T>* step) const {
    const int64_t columns = layer->outputs;
    const Matrix<T> gradient{static_cast<T*>(layer->weight_gradient) + from * columns, columns};
    Product<T> product{to - from, columns, rows, values.data + from, 1, values.stride, deltas.data, 1, deltas.stride, gradient};
    product.adds = adds, product.narrow = true;
    product.compute();
    if (step != nullptr) step->of(gradient.data, (to - from) * columns);
    if (from > 0) return;
    T* bias = static_cast<T*>(layer->bias_gradient);
    if (!adds) std::fill_n(bias, columns, T(0));
    for (int64_t row = 0; row < rows; ++row) {
      const T* delta = deltas.row(row);
      for (int64_t j = 0; j < columns; ++j) bias[j] += delta[j];
    }
    if (step != nullptr) step->of(bias, columns);
  }
};

// The weight gradients of networks: one thread takes them from each block of rows while it is in the cache, and needs room
// for one block. Several take them in the end. Both sum the rows in their order. A step, if there is one, changes weights as
// soon as their gradients are whole: the networks have been packed, and no one reads the weights themselves any more.
template <class T>
struct Weights {
  int64_t batch, block, threads;
  Team team;
  const Step<T>* step;

  bool at_once() const { return threads <= 1 || team == nullptr; }
  int64_t rows() const { return at_once() ? block : batch; }
  int64_t place(int64_t row) const { return at_once() ? 0 : row; }

  void of_block(const Packing<T>& network, const Trace<T>& trace, int64_t first, int64_t rows) const {
    if (!at_once()) return;
    const bool last = first + rows == batch;
    for (size_t l = network.size(); l-- > 0;) {
      const Part<T> whole{network[l].layer, trace.values[l], trace.deltas[l], 0, network[l].inputs};
      whole.compute(rows, first > 0, last ? step : nullptr);
    }
  }

  void of_all(const std::vector<std::pair<const Packing<T>*, const Trace<T>*>>& networks) const {
    if (at_once()) return;
    std::vector<Part<T>> parts;
    for (const auto& [network, trace] : networks) {
      for (size_t l = 0; l < network->size(); ++l) {
        const int64_t inputs = (*network)[l].inputs, size = block_of(inputs, threads, inputs);
        for (int64_t from = 0; from < inputs; from += size) {
          const int64_t to = std::min(from + size, inputs);
          parts.push_back({(*network)[l].layer, trace->values[l], trace->deltas[l], from, to});
        }
      }
    }
    spread(team, threads, parts.size(), [&](int64_t task, int64_t) { parts[task].compute(batch, false, step); });
  }
};

// Updates of networks that know nothing of each other, each with rows of its own: as many networks at once as there are
// threads, all updates of one after the other, so that its weights stay in the cache; what is left over by all threads
// together. Nobody's bits depend on that.
//
// `once` computes the gradients of one of the structures, moved to the rows of an update, in its memory, with a step of Adam;
// without memory it counts. Without `scratch` nothing is done, and the numbers that are needed there are returned.
template <class T, class Networks, class Once>
int64_t updates_of(const Networks* all, int64_t count, int64_t updates, const Adam& adam, T* scratch, Once once) {
  const int64_t threads = all->team == nullptr ? 1 : all->threads, apart = count / threads * threads;
  const auto with = [](Networks networks, int64_t threads, T* memory) {
    networks.threads = threads, networks.scratch = memory;
    if (threads == 1) networks.team = nullptr;
    return networks;
  };
  const int64_t room = once(with(*all, 1, nullptr), 0, nullptr);
  const int64_t together = apart == count ? 0 : once(with(*all, threads, nullptr), 0, nullptr);
  if (scratch == nullptr) return std::max(std::min(threads, apart) * room, together);
  const auto update = [&](const Networks& networks) {
    for (int64_t u = 0; u < updates; ++u) {
      const Step<T> step(adam, adam.steps + u + 1);
      once(networks, u, &step);
    }
  };
  spread(all->team, threads, apart, [&](int64_t n, int64_t worker) { update(with(all[n], 1, scratch + worker * room)); });
  for (int64_t n = apart; n < count; ++n) update(with(all[n], threads, scratch));
  return 0;
}

template <class T>
void copy_row(T* to, std::initializer_list<std::pair<const T*, int64_t>> parts) {
  for (const auto& [from, count] : parts) to = std::copy_n(from, count, to);
}

}  // namespace
