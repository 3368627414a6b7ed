// A series of kernel launches, and the CUDA graph that runs them without the host in between.
#pragma once

#include <cuda_runtime.h>

#include <cstring>
#include <vector>

#include "core/cuda_check.cuh"

namespace spslam {

// One launch of a kernel that takes one struct by value.
struct KernelLaunch {
  const void* kernel;
  int blocks, threads, shared_bytes;
  std::vector<unsigned char> arguments;

  template <class Arguments>
  KernelLaunch(const void* kernel_, int blocks_, int threads_, int shared_bytes_, const Arguments& arguments_)
      : kernel(kernel_), blocks(blocks_), threads(threads_), shared_bytes(shared_bytes_), arguments(sizeof(Arguments)) {
    std::memcpy(arguments.data(), &arguments_, sizeof(Arguments));
  }

  bool same_shape(const KernelLaunch& o) const {
    return kernel == o.kernel && blocks == o.blocks && threads == o.threads && shared_bytes == o.shared_bytes;
  }
};
using KernelLaunches = std::vector<KernelLaunch>;

// Launches one after the other from the host.
inline void run_launches(const KernelLaunches& launches, cudaStream_t stream) {
  for (const KernelLaunch& launch : launches) {
    void* arguments[] = {const_cast<unsigned char*>(launch.arguments.data())};
    SPS_CUDA_CHECK(cudaLaunchKernel(launch.kernel, dim3(launch.blocks), dim3(launch.threads), arguments,
                                    launch.shared_bytes, stream));
  }
}

// Keeps the graph of the last series. For a series of the same shape only the arguments are replaced, so that memory
// may grow without a new graph.
class LaunchGraph {
 public:
  LaunchGraph() = default;
  LaunchGraph(const LaunchGraph&) = delete;
  LaunchGraph& operator=(const LaunchGraph&) = delete;
  ~LaunchGraph() { clear(); }

  void run(const KernelLaunches& launches, cudaStream_t stream) {
    int device = 0;
    SPS_CUDA_CHECK(cudaGetDevice(&device));
    if (fits(launches, device)) {
      update(launches);
    } else {
      build(launches, device);
    }
    SPS_CUDA_CHECK(cudaGraphLaunch(executable_, stream));
  }

  // How often a graph was built.
  int builds() const { return builds_; }

 private:
  bool fits(const KernelLaunches& launches, int device) const {
    if (!executable_ || device != device_ || launches.size() != launches_.size()) return false;
    for (std::size_t i = 0; i < launches.size(); ++i) {
      if (!launches[i].same_shape(launches_[i])) return false;
    }
    return true;
  }

  void update(const KernelLaunches& launches) {
    for (std::size_t i = 0; i < launches.size(); ++i) {
      if (launches[i].arguments == launches_[i].arguments) continue;
      Node node(launches[i]);
      SPS_CUDA_CHECK(cudaGraphExecKernelNodeSetParams(executable_, nodes_[i], &node.parameters));
      launches_[i] = launches[i];
    }
  }

  void build(const KernelLaunches& launches, int device) {
    clear();
    SPS_CUDA_CHECK(cudaGraphCreate(&graph_, 0));
    for (const KernelLaunch& launch : launches) {
      const cudaGraphNode_t* before = nodes_.empty() ? nullptr : &nodes_.back();
      Node node(launch);
      cudaGraphNode_t added;
      SPS_CUDA_CHECK(cudaGraphAddKernelNode(&added, graph_, before, before ? 1 : 0, &node.parameters));
      nodes_.push_back(added);
    }
    SPS_CUDA_CHECK(cudaGraphInstantiate(&executable_, graph_, 0));
    launches_ = launches;
    device_ = device;
    ++builds_;
  }

  void clear() {
    // A graph may still be running; the runtime frees it after that.
    if (executable_) cudaGraphExecDestroy(executable_);
    if (graph_) cudaGraphDestroy(graph_);
    executable_ = nullptr;
    graph_ = nullptr;
    nodes_.clear();
    launches_.clear();
  }

  struct Node {
    void* arguments[1];
    cudaKernelNodeParams parameters{};

    explicit Node(const KernelLaunch& launch) : arguments{const_cast<unsigned char*>(launch.arguments.data())} {
      parameters.func = const_cast<void*>(launch.kernel);
      parameters.gridDim = dim3(launch.blocks);
      parameters.blockDim = dim3(launch.threads);
      parameters.sharedMemBytes = launch.shared_bytes;
      parameters.kernelParams = arguments;
    }
  };

  cudaGraph_t graph_ = nullptr;
  cudaGraphExec_t executable_ = nullptr;
  std::vector<cudaGraphNode_t> nodes_;
  KernelLaunches launches_;
  int device_ = -1, builds_ = 0;
};

// As a graph if there is one to keep it in, else one after the other.
inline void run_launches(const KernelLaunches& launches, LaunchGraph* graph, cudaStream_t stream) {
  if (graph) {
    graph->run(launches, stream);
  } else {
    run_launches(launches, stream);
  }
}

}  // namespace spslam
