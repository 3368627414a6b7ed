#include "launch/optimizer.h"

#include <algorithm>
#include <type_traits>

namespace spslam {
namespace {

constexpr std::int64_t kFlatGrain = 8192;
constexpr std::int64_t kRowGrain = 4096;
constexpr std::int64_t kScanBlock = 64;

template <class T>
void update_span(const AdamCoefficients<T>& c, std::int64_t count, T* __restrict param, T* __restrict grad,
                 T* __restrict exp_avg, T* __restrict exp_avg_sq) {
#pragma omp simd
  for (std::int64_t i = 0; i < count; ++i) adam_update(c, param[i], grad[i], exp_avg[i], exp_avg_sq[i]);
}

// Rows of [begin, end) with the wanted stamp, into `found`. Most blocks hold none and cost one vectorized comparison;
// the others are compacted without branches, since the branch would be unpredictable.
std::int64_t find_stamped(const std::int32_t* stamps, std::int32_t stamp, std::int64_t begin, std::int64_t end,
                          std::int64_t* found) {
  std::int64_t count = 0;
  for (std::int64_t block = begin; block < end; block += kScanBlock) {
    const std::int64_t block_end = std::min(block + kScanBlock, end);
    std::int32_t hits = 0;
    for (std::int64_t row = block; row < block_end; ++row) hits += stamps[row] == stamp;
    if (hits == 0) continue;
    for (std::int64_t row = block; row < block_end; ++row) {
      found[count] = row;
      count += stamps[row] == stamp;
    }
  }
  return count;
}

// `kChannels` > 0 fixes the row length at compile time, so that short rows fill whole vectors.
template <int kChannels, class T>
void update_stamped_rows(const AdamCoefficients<T>& c, std::int64_t rows, std::int64_t channels,
                         const std::int32_t* stamps, std::int32_t stamp, T* param, T* grad, T* exp_avg, T* exp_avg_sq) {
  const std::int64_t length = kChannels > 0 ? kChannels : channels;
  parallel_for(rows, kRowGrain, [=](std::int64_t begin, std::int64_t end) {
    std::int64_t found[kRowGrain + 1];  // the compaction writes one entry past the last hit
    const std::int64_t count = find_stamped(stamps, stamp, begin, end, found);
    for (std::int64_t i = 0; i < count; ++i) {
      const std::int64_t at = found[i] * length;
      update_span(c, length, param + at, grad + at, exp_avg + at, exp_avg_sq + at);
    }
  });
}

template <class T>
struct Vector;
template <>
struct Vector<float> {
  typedef float type __attribute__((vector_size(64)));
};
template <>
struct Vector<double> {
  typedef double type __attribute__((vector_size(64)));
};

// Sums of one chunk, with every kLanes-th residual in the same lane of a vector register. A residual of weight 0 is
// left out rather than multiplied by it, because it may not be finite.
template <class T>
void accumulate_chunk(std::int64_t count, const T* residuals, const T* jacobians, const T* weights, double* out) {
  using V = typename Vector<T>::type;
  constexpr int kLanes = sizeof(V) / sizeof(T);
  V sums[kNormalTerms] = {};
  for (std::int64_t base = 0; base < count; base += kLanes) {
    const int filled = static_cast<int>(std::min<std::int64_t>(kLanes, count - base));
    V r = {}, w = {}, j[6] = {};
    for (int lane = 0; lane < filled; ++lane) {
      const std::int64_t at = base + lane;
      if (weights[at] == T(0)) continue;
      w[lane] = weights[at];
      r[lane] = residuals[at];
      for (int a = 0; a < 6; ++a) j[a][lane] = jacobians[at * 6 + a];
    }
    add_normal_terms(j, r, w, sums);
  }
  for (int t = 0; t < kNormalTerms; ++t) {
    out[t] = 0.0;
    for (int lane = 0; lane < kLanes; ++lane) out[t] += static_cast<double>(sums[t][lane]);
  }
}

}  // namespace

template <class Device, class T>
void sparse_adam(Device, const AdamStep& step, std::int64_t rows, std::int64_t channels, const std::int32_t* stamps,
                 std::int32_t stamp, T* param, T* grad, T* exp_avg, T* exp_avg_sq) {
  const AdamCoefficients<T> c = adam_coefficients<T>(step);
  if (stamps == nullptr) {
    parallel_for(rows * channels, kFlatGrain, [=](std::int64_t begin, std::int64_t end) {
      update_span(c, end - begin, param + begin, grad + begin, exp_avg + begin, exp_avg_sq + begin);
    });
    return;
  }
  const auto update = [&](auto length) {
    update_stamped_rows<decltype(length)::value>(c, rows, channels, stamps, stamp, param, grad, exp_avg, exp_avg_sq);
  };
  switch (channels) {
    case 8:
      return update(std::integral_constant<int, 8>{});
    case 16:
      return update(std::integral_constant<int, 16>{});
    case 32:
      return update(std::integral_constant<int, 32>{});
    default:
      return update(std::integral_constant<int, 0>{});
  }
}

template <class Device, class T>
void normal_equations(Device device, std::int64_t frames, std::int64_t count, const T* residuals, const T* jacobians,
                      const T* weights, double* partials, T* hessian, T* gradient, T* cost) {
  const std::int64_t chunks = chunk_count(count, kNormalChunk);
  parallel_for(frames * chunks, 4, [=](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t frame = i / chunks, first = (i % chunks) * kNormalChunk, at = frame * count + first;
      accumulate_chunk(std::min(kNormalChunk, count - first), residuals + at, jacobians + at * 6, weights + at,
                       partials + i * kNormalTerms);
    }
  });
  reduce_normal_equations(device, frames, chunks, partials, hessian, gradient, cost);
}

SPS_INSTANTIATE_OPTIMIZER(Cpu, float)
SPS_INSTANTIATE_OPTIMIZER(Cpu, double)
}  // namespace spslam
