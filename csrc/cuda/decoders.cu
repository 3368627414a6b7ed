// One kernel for all layers, one tile of rows per block, where the network fits a block's shared memory; else one layer
// after the other.
#include "core/cuda_check.cuh"
#include "cuda/fused/column_sums.cuh"
#include "cuda/mlp_layers.cuh"
#include "cuda/mlp_tile.cuh"

namespace spslam {
namespace {

using namespace mlp_tile;

constexpr int kMaxThreads = kMaxWarps * kWarp;
// Some blocks on each multiprocessor of an H100; fewer where each leaves partial sums.
constexpr std::int64_t kMaxBlocks = 1056, kMaxGradientBlocks = 396;

template <class T>
struct Network {
  Layout layout;
  MlpActivation activation;
  const T* params;
  const T* input;
  std::int64_t n;

  // Calls f(first row, rows) for each of the block's tiles.
  template <class F>
  __device__ void for_each_tile(const F& f) const {
    const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kRows<T>;
    for (std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kRows<T>; first < n; first += stride) {
      f(first, static_cast<int>(n - first < kRows<T> ? n - first : kRows<T>));
    }
  }
};

extern __shared__ __align__(kVectorBytes) unsigned char shared_memory[];

template <class T>
__global__ void __launch_bounds__(kMaxThreads) forward_kernel(const __grid_constant__ Network<T> network, T* out) {
  const Layout& layout = network.layout;
  Tile<T> tile(layout, shared_memory);
  tile.load_network(network.params);
  network.for_each_tile([&](std::int64_t first, int rows) {
    tile.load_rows(network.input + first * layout.inputs(), rows);
    tile.forward();
    tile.store_outputs(network.activation, out + first * layout.outputs(), rows);
  });
}

// Sums of the block's tiles into a row of partials [blocks, num_params].
template <class T>
__global__ void __launch_bounds__(kMaxThreads)
    backward_kernel(const __grid_constant__ Network<T> network, const T* grad, T* grad_input, T* partials) {
  const Layout& layout = network.layout;
  Tile<T> tile(layout, shared_memory);
  tile.load_network(network.params);
  tile.clear_sums();
  network.for_each_tile([&](std::int64_t first, int rows) {
    tile.load_rows(network.input + first * layout.inputs(), rows);
    tile.forward();
    tile.activation_backward(network.activation, grad + first * layout.outputs(), rows);
    tile.backward(partials != nullptr, grad_input != nullptr);
    if (grad_input) tile.store_input_gradients(grad_input + first * layout.inputs(), rows);
  });
  if (partials) tile.store_sums(partials + static_cast<std::int64_t>(blockIdx.x) * layout.num_params);
}

template <class T>
__global__ void __launch_bounds__(fused::kSumThreads)
    sum_kernel(const T* partials, int blocks, int num_params, T* grad_params) {
  __shared__ T shared[fused::kSumWarps][kWarp];
  const int column = blockIdx.x * kWarp + threadIdx.x % kWarp, last = num_params - 1;
  const T sum = fused::sum_column(partials + (column < last ? column : last), num_params, blocks, shared);
  if (threadIdx.x < kWarp && column < num_params) grad_params[column] = sum;
}

// Whether a tile, its network and, if asked for, their gradients fit shared memory, for float and double.
bool fits(const MlpShape& shape, bool gradients) {
  constexpr std::int64_t kMaxWidth = 1024;
  if (shape.input > kMaxWidth || shape.hidden > kMaxWidth || shape.output > kMaxWidth) return false;
  int device = 0, available = 0;
  SPS_CUDA_CHECK(cudaGetDevice(&device));
  SPS_CUDA_CHECK(cudaDeviceGetAttribute(&available, cudaDevAttrMaxSharedMemoryPerBlockOptin, device));
  return make_layout<double>(shape, gradients).template bytes<double>() <= available;
}

std::int64_t num_blocks(std::int64_t tiles, std::int64_t max_blocks) {
  const std::int64_t rounds = chunk_count(tiles, max_blocks);
  return rounds > 0 ? chunk_count(tiles, rounds) : 0;
}

template <class T, class... Arguments, class... Values>
void launch(Cuda device, void (*kernel)(Network<T>, Arguments...), std::int64_t blocks, const Network<T>& network,
            Values... values) {
  if (blocks == 0) return;
  const int bytes = network.layout.template bytes<T>();
  SPS_CUDA_CHECK(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes));
  kernel<<<static_cast<int>(blocks), network.layout.warps() * kWarp, bytes, static_cast<cudaStream_t>(device.stream)>>>(
      network, values...);
  SPS_CUDA_CHECK(cudaGetLastError());
}

}  // namespace

template <>
std::int64_t mlp_workspace_size(Cuda, const MlpShape& shape, std::int64_t n) {
  return fits(shape, false) ? 0 : mlp_layers::workspace_size(shape, n);
}
template <>
std::int64_t mlp_backward_workspace_size(Cuda, const MlpShape& shape, std::int64_t n) {
  if (!fits(shape, true)) return mlp_layers::backward_workspace_size(shape, n);
  return num_blocks(chunk_count(n, kRows<double>), kMaxGradientBlocks) * shape.num_params();
}

template <class Device, class T>
void mlp(Device device, const MlpShape& shape, const T* input, std::int64_t n, const T* params, T* workspace, T* out) {
  if (!fits(shape, false)) return mlp_layers::forward(device, shape, input, n, params, workspace, out);
  const Network<T> network{make_layout<T>(shape, false), shape.activation, params, input, n};
  launch(device, forward_kernel<T>, num_blocks(chunk_count(n, kRows<T>), kMaxBlocks), network, out);
}

template <class Device, class T>
void mlp_backward(Device device, const MlpShape& shape, const T* grad, const T* input, std::int64_t n, const T* params,
                  T* workspace, T* grad_input, T* grad_params) {
  if (!fits(shape, true)) {
    return mlp_layers::backward(device, shape, grad, input, n, params, workspace, grad_input, grad_params);
  }
  const Network<T> network{make_layout<T>(shape, true), shape.activation, params, input, n};
  const std::int64_t blocks = num_blocks(chunk_count(n, kRows<T>), kMaxGradientBlocks);
  T* partials = grad_params ? workspace : nullptr;
  launch(device, backward_kernel<T>, blocks, network, grad, grad_input, partials);
  if (!grad_params) return;
  const int num_params = network.layout.num_params;
  sum_kernel<<<static_cast<int>(chunk_count(num_params, kWarp)), fused::kSumThreads, 0,
               static_cast<cudaStream_t>(device.stream)>>>(workspace, static_cast<int>(blocks), num_params,
                                                           grad_params);
  SPS_CUDA_CHECK(cudaGetLastError());
}

#define SPS_INSTANTIATE_DECODERS(T)                                                            \
  template void mlp<Cuda, T>(Cuda, const MlpShape&, const T*, std::int64_t, const T*, T*, T*); \
  template void mlp_backward<Cuda, T>(Cuda, const MlpShape&, const T*, const T*, std::int64_t, const T*, T*, T*, T*);
SPS_INSTANTIATE_DECODERS(float)
SPS_INSTANTIATE_DECODERS(double)

}  // namespace spslam
