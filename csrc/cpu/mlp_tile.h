// A small network on a tile of samples: the arithmetic of the decoders on the CPU.
//
// Samples are rows. Every layer, its gradient to the input and its gradient to the weights is then one matrix product
// whose right operand is read a vector at a time and whose left operand is broadcast, so one inner kernel serves all
// three, with no transposition and no sum across lanes. Rows are padded to whole vectors; padding columns are zero.
#pragma once

#include <cstdint>
#include <type_traits>

#include "cpu/simd.h"
#include "spslam/decoders.h"

namespace spslam {

// Rows that the inner kernel works on at once; tiles hold a multiple of it. With two vectors per row there are enough
// sums in flight for the multiply-add units, and they fit the registers.
constexpr int kRowBlock = kVectorRegisters == 32 ? 8 : 4;
constexpr int kColumnVectors = 2;
// The same for layers of eight vectors or more, where 16 registers hold four rows of three.
constexpr int kWideColumnVectors = kVectorRegisters == 32 ? 2 : 3;

// Samples of a tile whose forward and backward values stay in the L1 cache.
constexpr std::int64_t kTileRows = 64;

namespace detail {

// sums[m][n] += sum_k a[m * a_row + k * a_column] * b[k * b_stride + n], n in vectors.
template <class T, int M, int N>
inline __attribute__((always_inline)) void accumulate(const T* a, std::int64_t a_row, std::int64_t a_column, const T* b,
                                                      std::int64_t b_stride, std::int64_t depth,
                                                      Vector<T> (&sums)[M][N]) {
  for (std::int64_t k = 0; k < depth; ++k) {
    Vector<T> right[N];
#pragma GCC unroll 8
    for (int n = 0; n < N; ++n) {
      Vector<T> loaded = load_vector<Vector<T>>(b + k * b_stride + n * kLanes<T>);
      hold_in_register(loaded);
      right[n] = loaded;
    }
#pragma GCC unroll 8
    for (int m = 0; m < M; ++m) {
      const T left = a[m * a_row + k * a_column];
#pragma GCC unroll 8
      for (int n = 0; n < N; ++n) sums[m][n] += left * right[n];
    }
  }
}

// Splits `columns` (a multiple of the vector) from `column` on into blocks of kVectors, and the rest into smaller ones.
template <class T, int kVectors = kColumnVectors, class F>
inline __attribute__((always_inline)) void for_column_blocks(std::int64_t columns, const F& f,
                                                             std::int64_t column = 0) {
  for (; column + kVectors * kLanes<T> <= columns; column += kVectors * kLanes<T>) {
    f(column, std::integral_constant<int, kVectors>{});
  }
  if constexpr (kVectors > 1) for_column_blocks<T, kVectors - 1>(columns, f, column);
}

// out[r] = relu(x[r] W + bias) for `rows` rows, a multiple of kRowBlock.
template <class T, int kVectors = kColumnVectors>
inline void hidden_layer(const T* x, std::int64_t x_stride, std::int64_t inputs, const T* weights, const T* bias,
                         std::int64_t outputs, std::int64_t rows, T* out) {
  for_column_blocks<T, kVectors>(outputs, [&](std::int64_t column, auto vectors) {
    constexpr int N = decltype(vectors)::value;
    for (std::int64_t row = 0; row < rows; row += kRowBlock) {
      Vector<T> sums[kRowBlock][N];
#pragma GCC unroll 8
      for (int m = 0; m < kRowBlock; ++m) {
#pragma GCC unroll 8
        for (int n = 0; n < N; ++n) sums[m][n] = load_vector<Vector<T>>(bias + column + n * kLanes<T>);
      }
      accumulate<T, kRowBlock, N>(x + row * x_stride, x_stride, 1, weights + column, outputs, inputs, sums);
#pragma GCC unroll 8
      for (int m = 0; m < kRowBlock; ++m) {
#pragma GCC unroll 8
        for (int n = 0; n < N; ++n) {
          // Written so that NaN passes.
          const Vector<T> y = sums[m][n] < 0 ? Vector<T>{} : sums[m][n];
          store_vector(out + (row + m) * outputs + column + n * kLanes<T>, y);
        }
      }
    }
  });
}

// out[r] = g[r] W, zeroed where active[r] is not positive (active may be null), for `rows` rows, a multiple of
// kRowBlock.
template <class T>
inline void layer_input_gradient(const T* g, std::int64_t g_stride, std::int64_t outputs, const T* weights,
                                 std::int64_t inputs, const T* active, std::int64_t rows, T* out) {
  for_column_blocks<T>(inputs, [&](std::int64_t column, auto vectors) {
    constexpr int N = decltype(vectors)::value;
    for (std::int64_t row = 0; row < rows; row += kRowBlock) {
      Vector<T> sums[kRowBlock][N] = {};
      accumulate<T, kRowBlock, N>(g + row * g_stride, g_stride, 1, weights + column, inputs, outputs, sums);
#pragma GCC unroll 8
      for (int m = 0; m < kRowBlock; ++m) {
#pragma GCC unroll 8
        for (int n = 0; n < N; ++n) {
          const std::int64_t at = (row + m) * inputs + column + n * kLanes<T>;
          Vector<T> y = sums[m][n];
          if (active) y = load_vector<Vector<T>>(active + at) <= 0 ? Vector<T>{} : y;
          store_vector(out + at, y);
        }
      }
    }
  });
}

// weights[o] += sum_r g[r][o] * x[r], o < outputs (a multiple of kRowBlock), r < rows.
template <class T>
inline void add_layer_weight_gradient(const T* g, std::int64_t g_stride, std::int64_t outputs, const T* x,
                                      std::int64_t inputs, std::int64_t rows, T* weights) {
  for_column_blocks<T>(inputs, [&](std::int64_t column, auto vectors) {
    constexpr int N = decltype(vectors)::value;
    for (std::int64_t o = 0; o < outputs; o += kRowBlock) {
      Vector<T> sums[kRowBlock][N];
      T* w = weights + o * inputs + column;
#pragma GCC unroll 8
      for (int m = 0; m < kRowBlock; ++m) {
#pragma GCC unroll 8
        for (int n = 0; n < N; ++n) sums[m][n] = load_vector<Vector<T>>(w + m * inputs + n * kLanes<T>);
      }
      accumulate<T, kRowBlock, N>(g + o, 1, g_stride, x + column, inputs, rows, sums);
#pragma GCC unroll 8
      for (int m = 0; m < kRowBlock; ++m) {
#pragma GCC unroll 8
        for (int n = 0; n < N; ++n) store_vector(w + m * inputs + n * kLanes<T>, sums[m][n]);
      }
    }
  });
}

// sums[c] += sum_r factor(r) * x[r][c]. Four sums per column, so that additions do not wait for each other.
template <class T, class Factor>
inline void add_row_sums(const T* x, std::int64_t columns, std::int64_t rows, const Factor& factor, T* sums) {
  for (std::int64_t column = 0; column < columns; column += kLanes<T>) {
    Vector<T> partial[4] = {load_vector<Vector<T>>(sums + column)};
    const auto add = [&](std::int64_t r, int i) {
      partial[i] += factor(r) * load_vector<Vector<T>>(x + r * columns + column);
    };
    std::int64_t r = 0;
    for (; r + 4 <= rows; r += 4) {
#pragma GCC unroll 4
      for (int i = 0; i < 4; ++i) add(r + i, i);
    }
    for (; r < rows; ++r) add(r, 0);
    store_vector(sums + column, (partial[0] + partial[1]) + (partial[2] + partial[3]));
  }
}

}  // namespace detail

// Row strides and the places of the parameters in a padded parameter block, which also holds gradients. The rows of a
// matrix are outputs, as in the public layout.
template <class T>
struct MlpLayout {
  std::int64_t input, hidden, output;
  std::int64_t input_stride, hidden_stride;
  std::int64_t w1, b1, w2, b2, w3, b3, size;

  explicit MlpLayout(const MlpShape& shape)
      : input(shape.input),
        hidden(shape.hidden),
        output(shape.output),
        input_stride(round_up(shape.input, kLanes<T>)),
        hidden_stride(round_up(shape.hidden, kLanes<T> > kRowBlock ? kLanes<T> : kRowBlock)) {
    w1 = 0;
    b1 = w1 + hidden_stride * input_stride;
    w2 = b1 + hidden_stride;
    b2 = w2 + hidden_stride * hidden_stride;
    w3 = b2 + hidden_stride;
    b3 = w3 + output * hidden_stride;
    size = round_up(b3 + output, kLanes<T>);
  }

  // flat[i] (+)= or = padded, for every parameter: calls f(flat index, padded index).
  template <class F>
  void for_each_parameter(const F& f) const {
    std::int64_t flat = 0;
    const auto matrix = [&](std::int64_t rows, std::int64_t columns, std::int64_t at, std::int64_t stride) {
      for (std::int64_t r = 0; r < rows; ++r) {
        for (std::int64_t c = 0; c < columns; ++c) f(flat++, at + r * stride + c);
      }
    };
    matrix(hidden, input, w1, input_stride);
    matrix(1, hidden, b1, hidden_stride);
    matrix(hidden, hidden, w2, hidden_stride);
    matrix(1, hidden, b2, hidden_stride);
    matrix(output, hidden, w3, hidden_stride);
    matrix(1, output, b3, output);
  }
};

// The parameters of a network, padded, and the first two matrices transposed as well.
template <class T>
class PackedMlp {
 public:
  PackedMlp(const MlpShape& shape, const T* params) : layout(shape) {
    T* p = padded_.reserve(layout.size);
    for (std::int64_t i = 0; i < layout.size; ++i) p[i] = 0;
    layout.for_each_parameter([&](std::int64_t flat, std::int64_t at) { p[at] = params[flat]; });
    w1_transposed = transpose(p + layout.w1, layout.hidden_stride, layout.input_stride, transposed1_);
    w2_transposed = transpose(p + layout.w2, layout.hidden_stride, layout.hidden_stride, transposed2_);
  }

  const T* at(std::int64_t offset) const { return padded_.get() + offset; }

  const MlpLayout<T> layout;
  const T *w1_transposed, *w2_transposed;

 private:
  static const T* transpose(const T* w, std::int64_t rows, std::int64_t columns, ScratchBuffer<T>& buffer) {
    T* out = buffer.reserve(rows * columns);
    for (std::int64_t r = 0; r < rows; ++r) {
      for (std::int64_t c = 0; c < columns; ++c) out[c * rows + r] = w[r * columns + c];
    }
    return out;
  }

  ScratchBuffer<T> padded_, transposed1_, transposed2_;
};

// Layers of a network on `rows` samples, a multiple of kRowBlock. x [rows, input_stride], h1 and h2 [rows,
// hidden_stride]; out[o * out_stride + r] is output o before its activation.
template <class T>
inline void mlp_tile_forward(const PackedMlp<T>& net, std::int64_t rows, const T* x, T* h1, T* h2, T* out,
                             std::int64_t out_stride) {
  const MlpLayout<T>& l = net.layout;
  detail::hidden_layer(x, l.input_stride, l.input, net.w1_transposed, net.at(l.b1), l.hidden_stride, rows, h1);
  detail::hidden_layer(h1, l.hidden_stride, l.hidden, net.w2_transposed, net.at(l.b2), l.hidden_stride, rows, h2);
  for (std::int64_t o = 0; o < l.output; ++o) {
    const T* w = net.at(l.w3 + o * l.hidden_stride);
    const T bias = *net.at(l.b3 + o);
    for (std::int64_t r = 0; r < rows; ++r) {
      Vector<T> sum{};
      for (std::int64_t c = 0; c < l.hidden_stride; c += kLanes<T>) {
        sum += load_vector<Vector<T>>(w + c) * load_vector<Vector<T>>(h2 + r * l.hidden_stride + c);
      }
      out[o * out_stride + r] = bias + sum_lanes<T>(sum);
    }
  }
}

// Gradients of a tile from those of the outputs before their activation, grad_out[o * out_stride + r]. g1, g2 [rows,
// hidden_stride] are gradients of the hidden layers before ReLU; grad_x [rows, input_stride], or null.
template <class T>
inline void mlp_tile_backward(const PackedMlp<T>& net, std::int64_t rows, const T* h1, const T* h2, const T* grad_out,
                              std::int64_t out_stride, T* g1, T* g2, T* grad_x) {
  const MlpLayout<T>& l = net.layout;
  for (std::int64_t r = 0; r < rows; ++r) {
    for (std::int64_t c = 0; c < l.hidden_stride; c += kLanes<T>) {
      Vector<T> sum{};
      for (std::int64_t o = 0; o < l.output; ++o) {
        sum += grad_out[o * out_stride + r] * load_vector<Vector<T>>(net.at(l.w3 + o * l.hidden_stride + c));
      }
      const Vector<T> active = load_vector<Vector<T>>(h2 + r * l.hidden_stride + c);
      store_vector(g2 + r * l.hidden_stride + c, active <= 0 ? Vector<T>{} : sum);
    }
  }
  detail::layer_input_gradient(g2, l.hidden_stride, l.hidden, net.at(l.w2), l.hidden_stride, h1, rows, g1);
  if (grad_x) {
    detail::layer_input_gradient(g1, l.hidden_stride, l.hidden, net.at(l.w1), l.input_stride,
                                 static_cast<const T*>(nullptr), rows, grad_x);
  }
}

// Adds the gradients of the parameters from `rows` samples (any number) to a padded block, in the order of the samples.
template <class T>
inline void mlp_tile_add_weight_gradients(const MlpLayout<T>& l, std::int64_t rows, const T* x, const T* h1,
                                          const T* h2, const T* grad_out, std::int64_t out_stride, const T* g1,
                                          const T* g2, T* grads) {
  const auto one = [](std::int64_t) { return T(1); };
  detail::add_layer_weight_gradient(g1, l.hidden_stride, l.hidden_stride, x, l.input_stride, rows, grads + l.w1);
  detail::add_row_sums(g1, l.hidden_stride, rows, one, grads + l.b1);
  detail::add_layer_weight_gradient(g2, l.hidden_stride, l.hidden_stride, h1, l.hidden_stride, rows, grads + l.w2);
  detail::add_row_sums(g2, l.hidden_stride, rows, one, grads + l.b2);
  for (std::int64_t o = 0; o < l.output; ++o) {
    const T* g = grad_out + o * out_stride;
    detail::add_row_sums(
        h2, l.hidden_stride, rows, [g](std::int64_t r) { return g[r]; }, grads + l.w3 + o * l.hidden_stride);
    T sum = 0;
    for (std::int64_t r = 0; r < rows; ++r) sum += g[r];
    grads[l.b3 + o] += sum;
  }
}

}  // namespace spslam
