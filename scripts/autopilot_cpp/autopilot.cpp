// Steers Nomoto's model T r_dot + r = K delta with an exported heading policy at the policy's own step.
//
//   autopilot POLICY.pt TRACK.csv K T SPEED DT HEADING SECONDS
//
// SI and radians. Writes t,psi,r,delta,fault per step; prints the first ten step times and the median of the others in microseconds.
#include <ATen/Parallel.h>
#include <torch/script.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <iomanip>
#include <vector>

int main(int argc, char** argv) {
  if (argc != 9) {
    std::fprintf(stderr, "usage: autopilot POLICY.pt TRACK.csv K T SPEED DT HEADING SECONDS\n");
    return 2;
  }
  try {
    at::set_num_threads(1);
    // the profiling executor compiles during the first calls, which would break the control period
    torch::jit::getProfilingMode() = false;
    torch::jit::setGraphExecutorOptimize(false);
    c10::InferenceMode guard;
    torch::jit::Module policy = torch::jit::load(argv[1]);
    policy.eval();
    const double gain = std::atof(argv[3]), time = std::atof(argv[4]), speed = std::atof(argv[5]);
    const double dt = std::atof(argv[6]), heading = std::atof(argv[7]);
    const int steps = static_cast<int>(std::lround(std::atof(argv[8]) / dt));
    std::ofstream track(argv[2]);
    if (!track) {
      std::fprintf(stderr, "autopilot: cannot write %s\n", argv[2]);
      return 2;
    }
    track << "t,psi,r,delta,fault\n" << std::setprecision(17);

    double psi = 0.0, r = 0.0;
    const double decay = std::exp(-dt / time);
    auto y = torch::zeros({1, 3}), reference = torch::full({1, 1}, heading);
    y[0][1] = speed;
    torch::Tensor memory = policy.get_method("initial_state")({y}).toTensor();
    auto step = policy.get_method("step");
    std::vector<double> taken;
    for (int k = 0; k < steps; ++k) {
      float* seen = y.data_ptr<float>();
      seen[0] = static_cast<float>(psi);
      seen[2] = static_cast<float>(r);
      const auto begin = std::chrono::steady_clock::now();
      const auto answer = step({y, reference, memory});
      const auto& parts = answer.toTupleRef().elements();
      const double delta = parts[0].toTensor().item<float>();
      memory = parts[1].toTensor();
      const bool fault = parts[2].toTensor().item<bool>();
      taken.push_back(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - begin).count());
      track << k * dt << ',' << psi << ',' << r << ',' << delta << ',' << fault << '\n';
      // exact for a rudder that is held over the step
      const double steady = gain * delta;
      psi += steady * dt + (r - steady) * time * (1.0 - decay);
      r = steady + (r - steady) * decay;
    }
    std::printf("first ten steps [us]:");
    for (int k = 0; k < std::min<int>(10, steps); ++k) std::printf(" %.0f", taken[k]);
    std::vector<double> warm(taken.begin() + std::min<int>(10, steps), taken.end());
    if (!warm.empty()) {
      std::nth_element(warm.begin(), warm.begin() + warm.size() / 2, warm.end());
      std::printf("\nmedian step [us]: %.1f\n", warm[warm.size() / 2]);
    }
  } catch (const std::exception& error) {
    std::fprintf(stderr, "autopilot: %s\n", error.what());
    return 1;
  }
  return 0;
}
