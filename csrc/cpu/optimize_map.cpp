#include "launch/optimize_map.h"

namespace spslam {

template <>
std::int64_t optimize_map_workspace_size(Cpu device, const MapOptimization& call) {
  return OptimizeMapLaunch<Cpu>(device, call, nullptr).bytes();
}

template <>
void optimize_map(Cpu device, const MapOptimization& call, void* workspace, LaunchGraph*) {
  OptimizeMapLaunch<Cpu>(device, call, workspace).run();
}

}  // namespace spslam
