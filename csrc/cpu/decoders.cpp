#include "spslam/decoders.h"

#include <vector>

#include "core/parallel.h"
#include "cpu/mlp_tile.h"
#include "kernels/decoders.h"

namespace spslam {
namespace {

constexpr std::int64_t kForwardGrain = 16 * kTileRows;
// Parameter gradients are summed per chunk, then over chunks: at most kMaxChunks blocks of partial sums.
constexpr std::int64_t kMaxChunks = 64;

std::int64_t gradient_grain(std::int64_t n) {
  const std::int64_t share = round_up(chunk_count(n, kMaxChunks), kTileRows);
  return share > 4 * kTileRows ? share : 4 * kTileRows;
}

// What a thread needs to run one tile forward and backward.
template <class T>
class Tile {
 public:
  explicit Tile(const MlpLayout<T>& l)
      : x(buffers_[0].reserve(kTileRows * l.input_stride)),
        grad_x(buffers_[1].reserve(kTileRows * l.input_stride)),
        h1(buffers_[2].reserve(kTileRows * l.hidden_stride)),
        h2(buffers_[3].reserve(kTileRows * l.hidden_stride)),
        g1(buffers_[4].reserve(kTileRows * l.hidden_stride)),
        g2(buffers_[5].reserve(kTileRows * l.hidden_stride)),
        out(buffers_[6].reserve(kTileRows * l.output)),
        layout_(l) {}

  // Loads rows [begin, begin + rows) of input and zeroes up to the next row block.
  void load(const T* input, std::int64_t begin, std::int64_t rows) {
    const std::int64_t padded = round_up(rows, kRowBlock);
    for (std::int64_t r = 0; r < padded; ++r) {
      for (std::int64_t c = 0; c < layout_.input_stride; ++c) {
        x[r * layout_.input_stride + c] = r < rows && c < layout_.input ? input[(begin + r) * layout_.input + c] : T(0);
      }
    }
  }

  // Replaces outputs by gradients before the activation, from grad [rows, output] after it.
  void activation_backward(MlpActivation activation, const T* grad, std::int64_t rows) {
    const std::int64_t padded = round_up(rows, kRowBlock);
    for (std::int64_t o = 0; o < layout_.output; ++o) {
      for (std::int64_t r = 0; r < padded; ++r) {
        T& y = out[o * kTileRows + r];
        y = r < rows ? grad[r * layout_.output + o] * activation_slope(activation, activate(activation, y)) : T(0);
      }
    }
  }

 private:
  ScratchBuffer<T> buffers_[7];

 public:
  T *const x, *const grad_x, *const h1, *const h2, *const g1, *const g2, *const out;

 private:
  const MlpLayout<T>& layout_;
};

template <class T, class F>
void for_each_tile(std::int64_t begin, std::int64_t end, const F& f) {
  for (std::int64_t row = begin; row < end; row += kTileRows) f(row, row + kTileRows < end ? kTileRows : end - row);
}

}  // namespace

template <>
std::int64_t mlp_workspace_size(Cpu, const MlpShape&, std::int64_t) {
  return 0;
}
template <>
std::int64_t mlp_backward_workspace_size(Cpu, const MlpShape&, std::int64_t) {
  return 0;
}

template <class Device, class T>
void mlp(Device, const MlpShape& shape, const T* input, std::int64_t n, const T* params, T*, T* out) {
  const PackedMlp<T> net(shape, params);
  parallel_for(n, kForwardGrain, [&](std::int64_t begin, std::int64_t end) {
    Tile<T> tile(net.layout);
    for_each_tile<T>(begin, end, [&](std::int64_t row, std::int64_t rows) {
      tile.load(input, row, rows);
      mlp_tile_forward(net, round_up(rows, kRowBlock), tile.x, tile.h1, tile.h2, tile.out, kTileRows);
      for (std::int64_t o = 0; o < shape.output; ++o) {
        const T* y = tile.out + o * kTileRows;
        for (std::int64_t r = 0; r < rows; ++r) out[(row + r) * shape.output + o] = activate(shape.activation, y[r]);
      }
    });
  });
}

template <class Device, class T>
void mlp_backward(Device, const MlpShape& shape, const T* grad, const T* input, std::int64_t n, const T* params, T*,
                  T* grad_input, T* grad_params) {
  const PackedMlp<T> net(shape, params);
  const MlpLayout<T>& layout = net.layout;
  const std::int64_t grain = gradient_grain(n), chunks = chunk_count(n, grain);
  std::vector<T> partials(static_cast<std::size_t>(grad_params ? chunks * layout.size : 0));
  parallel_chunks(n, grain, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
    Tile<T> tile(layout);
    for_each_tile<T>(begin, end, [&](std::int64_t row, std::int64_t rows) {
      const std::int64_t padded = round_up(rows, kRowBlock);
      tile.load(input, row, rows);
      mlp_tile_forward(net, padded, tile.x, tile.h1, tile.h2, tile.out, kTileRows);
      tile.activation_backward(shape.activation, grad + row * shape.output, rows);
      mlp_tile_backward(net, padded, tile.h1, tile.h2, tile.out, kTileRows, tile.g1, tile.g2,
                        grad_input ? tile.grad_x : nullptr);
      if (grad_params) {
        mlp_tile_add_weight_gradients(layout, rows, tile.x, tile.h1, tile.h2, tile.out, kTileRows, tile.g1, tile.g2,
                                      partials.data() + chunk * layout.size);
      }
      if (!grad_input) return;
      for (std::int64_t r = 0; r < rows; ++r) {
        for (std::int64_t c = 0; c < shape.input; ++c) {
          grad_input[(row + r) * shape.input + c] = tile.grad_x[r * layout.input_stride + c];
        }
      }
    });
  });
  if (!grad_params) return;
  layout.for_each_parameter([&](std::int64_t flat, std::int64_t at) {
    T sum = 0;
    for (std::int64_t chunk = 0; chunk < chunks; ++chunk) sum += partials[chunk * layout.size + at];
    grad_params[flat] = sum;
  });
}

#define SPS_INSTANTIATE_DECODERS(T)                                                          \
  template void mlp<Cpu, T>(Cpu, const MlpShape&, const T*, std::int64_t, const T*, T*, T*); \
  template void mlp_backward<Cpu, T>(Cpu, const MlpShape&, const T*, const T*, std::int64_t, const T*, T*, T*, T*);
SPS_INSTANTIATE_DECODERS(float)
SPS_INSTANTIATE_DECODERS(double)

}  // namespace spslam
