// Steers Nomoto's model T r_dot + r = K delta with an exported heading policy at the policy's own step.
//
//   autopilot POLICY.pt TRACK.csv K T SPEED DT HEADING SECONDS
//
// SI and radians. Writes t,psi,r,delta,fault per step; prints the first ten step times and the median of the others in microseconds.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <iomanip>

#include "stepping.hpp"

int main(int argc, char** argv) {
  if (argc != 9) {
    std::fprintf(stderr, "usage: autopilot POLICY.pt TRACK.csv K T SPEED DT HEADING SECONDS\n");
    return 2;
  }
  try {
    c10::InferenceMode guard;
    torch::jit::Module policy = load_for_steps(argv[1]);
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
    StepTimes times;
    for (int k = 0; k < steps; ++k) {
      float* seen = y.data_ptr<float>();
      seen[0] = static_cast<float>(psi);
      seen[2] = static_cast<float>(r);
      times.begin();
      const auto answer = step({y, reference, memory});
      const auto& parts = answer.toTupleRef().elements();
      const double delta = parts[0].toTensor().item<float>();
      memory = parts[1].toTensor();
      const bool fault = parts[2].toTensor().item<bool>();
      times.end();
      track << k * dt << ',' << psi << ',' << r << ',' << delta << ',' << fault << '\n';
      // exact for a rudder that is held over the step
      const double steady = gain * delta;
      psi += steady * dt + (r - steady) * time * (1.0 - decay);
      r = steady + (r - steady) * decay;
    }
    times.print();
  } catch (const std::exception& error) {
    std::fprintf(stderr, "autopilot: %s\n", error.what());
    return 1;
  }
  return 0;
}
