#include "spslam/prior_fusion.h"

#include "arrays.h"

namespace spslam::numpy {
namespace {

py::array_t<float> normals_of(const py::object& depth, const py::object& pixels, double fx, double fy, double cx,
                              double cy, std::int64_t step_px, double max_jump) {
  const char* name = "depth_normals";
  const Input<float> image({name, "depth"}, depth, {"H", "W"});
  const Input<std::int32_t> at({name, "pixels"}, pixels, {"N", 2});
  check(fx > 0, {name, "fx"}, "be positive", fx);
  check(fy > 0, {name, "fy"}, "be positive", fy);
  check(step_px >= 1 && step_px <= 65535, {name, "step_px"}, "be in [1, 65535]", step_px);
  check(max_jump > 0, {name, "max_jump"}, "be positive", max_jump);
  const DepthImage view{
      image.data(),
      static_cast<std::int32_t>(image.size(1)),
      static_cast<std::int32_t>(image.size(0)),
      {static_cast<float>(fx), static_cast<float>(fy), static_cast<float>(cx), static_cast<float>(cy)}};
  auto out = empty<float>({at.size(0), 3});
  float* normals = out.mutable_data();
  without_gil([&] {
    depth_normals(kCpu, view, at.data(), at.size(0), static_cast<std::int32_t>(step_px), static_cast<float>(max_jump),
                  normals);
  });
  return out;
}

py::tuple encode(const py::object& points, const py::object& normals, const py::object& encoder_params,
                 double voxel_size, std::int64_t neighborhood, double min_pair_weight) {
  const char* name = "encode_points";
  const Input<float> at({name, "points"}, points, {"N", 3});
  const std::int64_t n = at.size(0);
  const Input<float> facing({name, "normals"}, normals, {n, 3});
  const Input<float> params({name, "encoder_params"}, encoder_params, {kEncoderParameters});
  check(voxel_size > 0, {name, "voxel_size"}, "be positive", voxel_size);
  check(neighborhood == 8 || neighborhood == 64, {name, "neighborhood"}, "be 64 or 8", neighborhood);
  check(min_pair_weight >= 0, {name, "min_pair_weight"}, "be at least 0", min_pair_weight);
  const EncoderSettings settings{static_cast<float>(voxel_size), static_cast<std::int32_t>(neighborhood),
                                 static_cast<float>(min_pair_weight), false};
  py::array_t<std::int32_t> voxel_coords;
  py::array_t<float> features, weights;
  without_gil([&] {
    encode_points(kCpu, at.data(), facing.data(), n, params.data(), settings, AllocateScratch{},
                  [&](std::int64_t count) {
                    py::gil_scoped_acquire acquire;
                    voxel_coords = empty<std::int32_t>({count, 3});
                    features = empty<float>({count, kPriorFeatures});
                    weights = empty<float>({count});
                    return EncodedVoxels{voxel_coords.mutable_data(), features.mutable_data(), weights.mutable_data()};
                  });
  });
  return py::make_tuple(voxel_coords, features, weights);
}

void fuse(const py::object& embeddings, const py::object& weights, const py::object& voxel_ids,
          const py::object& features, const py::object& feature_weights, double max_weight) {
  const char* name = "fuse_prior_";
  InOut<float> table({name, "embeddings"}, embeddings, {"V", kPriorFeatures});
  InOut<float> totals({name, "weights"}, weights, {table.size(0)});
  const Input<std::int32_t> ids({name, "voxel_ids"}, voxel_ids, {"M"});
  const Input<float> added({name, "features"}, features, {ids.size(0), kPriorFeatures});
  const Input<float> shares({name, "feature_weights"}, feature_weights, {ids.size(0)});
  check(max_weight > 0, {name, "max_weight"}, "be positive", max_weight);
  without_gil([&] {
    fuse_prior(kCpu, ids.data(), added.data(), shares.data(), ids.size(0), table.size(0),
               static_cast<float>(max_weight), table.data(), totals.data());
  });
}

py::array_t<float> random(const py::object& voxel_coords, std::int64_t seed, double scale) {
  const char* name = "random_embeddings";
  const Input<std::int32_t> coords({name, "voxel_coords"}, voxel_coords, {"M", 3});
  check(scale >= 0, {name, "scale"}, "be at least 0", scale);
  auto out = empty<float>({coords.size(0), kPriorFeatures});
  float* embeddings = out.mutable_data();
  without_gil(
      [&] { random_embeddings(kCpu, coords.data(), coords.size(0), seed, static_cast<float>(scale), embeddings); });
  return out;
}

}  // namespace

void define_prior_fusion(py::module_& m) {
  m.attr("ENCODER_PARAMETERS") = kEncoderParameters;
  m.def("depth_normals", &normals_of, py::arg("depth"), py::arg("pixels"), py::arg("fx"), py::arg("fy"), py::arg("cx"),
        py::arg("cy"), py::arg("step_px"), py::arg("max_jump"),
        "Unit normals float32 [N, 3] in camera axes at pixels int32 [N, 2] of depth float32 [H, W] (m); 0 = unknown.");
  m.def("encode_points", &encode, py::arg("points"), py::arg("normals"), py::arg("encoder_params"),
        py::arg("voxel_size"), py::arg("neighborhood") = 64, py::arg("min_pair_weight") = 1e-4,
        "voxel_coords int32 [M, 3], features float32 [M, 8] and weights float32 [M] of the vertices around points "
        "float32 [N, 3] (m) with normals float32 [N, 3].");
  m.def("fuse_prior_", &fuse, py::arg("embeddings"), py::arg("weights"), py::arg("voxel_ids"), py::arg("features"),
        py::arg("feature_weights"), py::arg("max_weight"),
        "Weighted running mean of rows voxel_ids int32 [M] of embeddings float32 [V, 8], in place; the total weight in "
        "weights float32 [V] is capped.");
  m.def("random_embeddings", &random, py::arg("voxel_coords"), py::arg("seed"), py::arg("scale") = 0.01,
        "float32 [M, 8] from N(0, scale^2) that voxel and seed alone decide on.");
}

}  // namespace spslam::numpy
