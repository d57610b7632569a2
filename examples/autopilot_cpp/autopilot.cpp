// Steers Nomoto's model T r_dot + r = K delta with an exported heading policy at the policy's own step.
//
//   autopilot POLICY.pt TRACK.csv K T SPEED DT HEADING SECONDS [DELAY NOISE_PSI NOISE_R]
//
// SI and radians. Commands act DELAY seconds late, in whole steps; heading and yaw rate are measured with noise of these standard deviations. Writes t,psi,r,delta,fault per step; prints the first ten step times and the median of the others in microseconds.
#include <cmath>
#include <cstdio>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <exception>
#include <fstream>
#include <iomanip>

#include "stepping.hpp"

// Even noise of unit variance, the same on every machine: SplitMix64 (Steele, Lea and Flood, 2014).
double noise(std::uint64_t& state) {
  std::uint64_t z = (state += 0x9e3779b97f4a7c15ULL);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
  z ^= z >> 31;
  return (static_cast<double>(z >> 11) / 9007199254740992.0 - 0.5) * std::sqrt(12.0);
}

int main(int argc, char** argv) {
  if (argc != 9 && argc != 12) {
    std::fprintf(stderr, "usage: autopilot POLICY.pt TRACK.csv K T SPEED DT HEADING SECONDS [DELAY NOISE_PSI NOISE_R]\n");
    return 2;
  }
  try {
    c10::InferenceMode guard;
    torch::jit::Module policy = load_for_steps(argv[1]);
    const double gain = std::atof(argv[3]), time = std::atof(argv[4]), speed = std::atof(argv[5]);
    const double dt = std::atof(argv[6]), heading = std::atof(argv[7]);
    const int steps = static_cast<int>(std::lround(std::atof(argv[8]) / dt));
    const double delay = argc > 9 ? std::atof(argv[9]) : 0.0;
    const double noise_psi = argc > 9 ? std::atof(argv[10]) : 0.0, noise_r = argc > 9 ? std::atof(argv[11]) : 0.0;
    std::deque<double> late(static_cast<std::size_t>(std::lround(delay / dt)), 0.0);
    std::uint64_t drawn = 1;
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
      seen[0] = static_cast<float>(psi + noise_psi * noise(drawn));
      seen[2] = static_cast<float>(r + noise_r * noise(drawn));
      times.begin();
      const auto answer = step({y, reference, memory});
      const auto& parts = answer.toTupleRef().elements();
      const double delta = parts[0].toTensor().item<float>();
      memory = parts[1].toTensor();
      const bool fault = parts[2].toTensor().item<bool>();
      times.end();
      track << k * dt << ',' << psi << ',' << r << ',' << delta << ',' << fault << '\n';
      late.push_back(delta);
      // exact for a rudder that is held over the step
      const double steady = gain * late.front();
      late.pop_front();
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
