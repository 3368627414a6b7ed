#include "bindings/launch_graph.h"

#ifdef SPS_CUDA
#include <map>
#include <memory>
#include <mutex>

#include "spslam/launch_graph.h"

namespace spslam::bindings {
namespace {

struct FreeLaunchGraph {
  void operator()(LaunchGraph* graph) const { free_launch_graph(graph); }
};

// Numbers are not reused, so that a stale one is detected.
struct Registry {
  std::mutex mutex;
  std::map<std::int64_t, std::unique_ptr<LaunchGraph, FreeLaunchGraph>> graphs;
  std::int64_t last = 0;
};

// Never destroyed: at exit the driver may already be unloaded.
Registry& registry() {
  static Registry* const instance = new Registry;
  return *instance;
}

std::int64_t new_launch_graph() {
  Registry& r = registry();
  const std::lock_guard<std::mutex> lock(r.mutex);
  r.graphs[++r.last].reset(make_launch_graph());
  return r.last;
}

void delete_launch_graph(std::int64_t number) {
  Registry& r = registry();
  const std::lock_guard<std::mutex> lock(r.mutex);
  r.graphs.erase(number);
}

std::int64_t launch_graph_builds_op(std::int64_t number) {
  const LaunchGraph* const graph = find_launch_graph(number);
  return graph ? launch_graph_builds(graph) : 0;
}

}  // namespace

LaunchGraph* find_launch_graph(std::int64_t number) {
  if (number == 0) return nullptr;
  Registry& r = registry();
  const std::lock_guard<std::mutex> lock(r.mutex);
  const auto found = r.graphs.find(number);
  SPS_CHECK(found != r.graphs.end(), "spslam: graph must name a launch graph that exists, got ", number);
  return found->second.get();
}

STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("new_launch_graph() -> int");
  m.def("delete_launch_graph(int number) -> ()");
  m.def("launch_graph_builds(int number) -> int");
}

STABLE_TORCH_LIBRARY_IMPL(spslam, CompositeExplicitAutograd, m) {
  m.impl("new_launch_graph", TORCH_BOX(&new_launch_graph));
  m.impl("delete_launch_graph", TORCH_BOX(&delete_launch_graph));
  m.impl("launch_graph_builds", TORCH_BOX(&launch_graph_builds_op));
}

}  // namespace spslam::bindings

#else

namespace spslam::bindings {

LaunchGraph* find_launch_graph(std::int64_t) {
  return nullptr;
}

}  // namespace spslam::bindings

#endif
