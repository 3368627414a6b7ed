// Operands of the decoders' weight gradients: the inputs, hidden activations and deltas of a warp's tile.
#pragma once

#include "cuda/fused/decoder_image.cuh"

namespace spslam::fused {

// bf16 for tensor cores, float where everything is float.
template <Precision kPrecision>
struct StageElement {
  using type = __nv_bfloat16;
};
template <>
struct StageElement<Precision::kFp32> {
  using type = float;
};

// Row lengths avoid bank conflicts between neighboring rows.
template <Precision kPrecision>
struct alignas(16) Stage {
  using Element = typename StageElement<kPrecision>::type;
  static constexpr int kNarrow = 24, kWide = 40, kOut = 8;

  Element geometry_x[kTileRows][kNarrow], geometry_h1[kTileRows][kWide], geometry_h2[kTileRows][kWide];
  Element geometry_d1[kTileRows][kWide], geometry_d2[kTileRows][kWide], geometry_d3[kTileRows][kOut];
  Element color_x[kTileRows][kWide], color_h1[kTileRows][kWide], color_h2[kTileRows][kWide];
  Element color_d1[kTileRows][kWide], color_d2[kTileRows][kWide], color_d3[kTileRows][kOut];
};

// Which decoders' tiles a warp has staged.
constexpr int kStagedGeometry = 1, kStagedColor = 2;

__device__ __forceinline__ void store_pair(__nv_bfloat16* out, float a, float b) {
  *reinterpret_cast<__nv_bfloat162*>(out) = __floats2bfloat162_rn(a, b);
}
__device__ __forceinline__ void store_pair(float* out, float a, float b) {
  *reinterpret_cast<float2*>(out) = make_float2(a, b);
}

// Stores a fragment as rows.
template <class Element, int NT, int kStride>
__device__ __forceinline__ void store_tile(Element (&rows)[kTileRows][kStride], const float (&x)[NT][4], int lane) {
  const int row = lane_row(lane), quad = lane_quad(lane);
#pragma unroll
  for (int j = 0; j < NT; ++j) {
    store_pair(&rows[row][8 * j + 2 * quad], x[j][0], x[j][1]);
    store_pair(&rows[row + 8][8 * j + 2 * quad], x[j][2], x[j][3]);
  }
}

// Up to four output gradients per row, the rest zero; every lane of a row holds all of its row's.
template <class Element>
__device__ __forceinline__ void store_outputs(Element (&rows)[kTileRows][8], const float (&d)[2][4], int lane) {
  const int quad = lane_quad(lane);
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    const float first = quad == 0 ? d[r][0] : (quad == 1 ? d[r][2] : 0.0f);
    const float second = quad == 0 ? d[r][1] : (quad == 1 ? d[r][3] : 0.0f);
    store_pair(&rows[lane_row(lane) + 8 * r][2 * quad], first, second);
  }
}

}  // namespace spslam::fused
