// The backward pass of a decoder over the samples of a chunk.
#pragma once

#include "cpu/render_step_chunk.h"

namespace spslam::render {

// A decoder's rows over the samples of a chunk.
struct DecoderRows {
  std::int64_t count;
  const float *x, *h1, *h2;  // input, hidden layers
  const float* grad_out;     // of output o before its activation, at grad_out[o * out_stride + row]
  std::int64_t out_stride;
};

// From the gradients of the outputs to those of the parameters (added to `partial`, unless null), of the table's rows
// (written to `table`, unless null) and, if `points`, of the samples' points, by add_points(grad_x, first, rows).
template <class AddPoints>
inline void decoder_backward(const PackedMlp<float>& net, const DecoderRows& decoder, float* partial, float* table,
                             bool points, Chunk& chunk, const AddPoints& add_points) {
  const MlpLayout<float>& l = net.layout;
  for (std::int64_t row = 0; row < decoder.count; row += kTileRows) {
    const std::int64_t rows = row + kTileRows < decoder.count ? kTileRows : decoder.count - row;
    const float *h1 = decoder.h1 + row * l.hidden_stride, *h2 = decoder.h2 + row * l.hidden_stride;
    const float* grad_out = decoder.grad_out + row;
    float* grad_x = table ? table + row * l.input_stride : chunk.grad_x;
    mlp_tile_backward(net, round_up(rows, kRowBlock), h1, h2, grad_out, decoder.out_stride, chunk.g1, chunk.g2,
                      table || points ? grad_x : nullptr);
    if (partial) {
      mlp_tile_add_weight_gradients(l, rows, decoder.x + row * l.input_stride, h1, h2, grad_out, decoder.out_stride,
                                    chunk.g1, chunk.g2, partial);
    }
    if (points) add_points(grad_x, row, rows);
  }
}

}  // namespace spslam::render
