// What programs that call an exported controller once per control period share: loading, and how long the steps take.
#pragma once

#include <ATen/Parallel.h>
#include <torch/script.h>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdio>
#include <vector>

// One thread, and no profiling: the profiling executor compiles during the first calls, which would break the control period.
inline torch::jit::Module load_for_steps(const char* path) {
  at::set_num_threads(1);
  torch::jit::getProfilingMode() = false;
  torch::jit::setGraphExecutorOptimize(false);
  torch::jit::Module module = torch::jit::load(path);
  module.eval();
  return module;
}

// Times of steps in microseconds.
class StepTimes {
 public:
  void begin() { begun_ = std::chrono::steady_clock::now(); }
  void end() { taken_.push_back(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - begun_).count()); }

  // The first ten, and the median of the others.
  void print() const {
    const std::size_t first = std::min<std::size_t>(10, taken_.size());
    std::printf("first ten steps [us]:");
    for (std::size_t k = 0; k < first; ++k) std::printf(" %.0f", taken_[k]);
    std::printf("\n");
    std::vector<double> warm(taken_.begin() + static_cast<std::ptrdiff_t>(first), taken_.end());
    if (warm.empty()) return;
    std::nth_element(warm.begin(), warm.begin() + static_cast<std::ptrdiff_t>(warm.size() / 2), warm.end());
    std::printf("median step [us]: %.1f\n", warm[warm.size() / 2]);
  }

 private:
  std::chrono::steady_clock::time_point begun_;
  std::vector<double> taken_;
};
