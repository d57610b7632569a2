// Steers Nomoto's model T r_dot + r = K delta along a course with an exported module of policy and guidance, at the module's own step.
//
//   course COURSE.pt TRACK.csv K T SPEED DT NORTH EAST HEADING SECONDS
//
// SI and radians. Writes t,x,y,psi,r,delta,fault per step until the course ends; prints the first ten step times and the median of the others in
// microseconds, and when the course ended.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <iomanip>

#include "stepping.hpp"

int main(int argc, char** argv) {
  if (argc != 11) {
    std::fprintf(stderr, "usage: course COURSE.pt TRACK.csv K T SPEED DT NORTH EAST HEADING SECONDS\n");
    return 2;
  }
  try {
    c10::InferenceMode guard;
    torch::jit::Module module = load_for_steps(argv[1]);
    const double gain = std::atof(argv[3]), time = std::atof(argv[4]), speed = std::atof(argv[5]), dt = std::atof(argv[6]);
    const int steps = static_cast<int>(std::lround(std::atof(argv[10]) / dt));
    std::ofstream track(argv[2]);
    if (!track) {
      std::fprintf(stderr, "course: cannot write %s\n", argv[2]);
      return 2;
    }
    track << "t,x,y,psi,r,delta,fault\n" << std::setprecision(17);

    double x = std::atof(argv[7]), y = std::atof(argv[8]), psi = std::atof(argv[9]), r = 0.0;
    const double decay = std::exp(-dt / time);
    auto seen = torch::zeros({1, 6}, torch::kFloat64);
    double* measured = seen.data_ptr<double>();
    auto measure = [&] {
      const double values[] = {x, y, psi, speed, 0.0, r};
      for (int i = 0; i < 6; ++i) measured[i] = values[i];
    };
    measure();
    torch::Tensor memory = module.get_method("initial_state")({seen}).toTensor();
    auto step = module.get_method("step");
    StepTimes times;
    bool arrived = false;
    int k = 0;
    for (; k < steps && !arrived; ++k) {
      measure();
      times.begin();
      const auto answer = step({seen, memory});
      const auto& parts = answer.toTupleRef().elements();
      const double delta = parts[0].toTensor().item<double>();
      memory = parts[1].toTensor();
      const bool fault = parts[2].toTensor().item<bool>();
      arrived = parts[3].toTensor().item<bool>();
      times.end();
      track << k * dt << ',' << x << ',' << y << ',' << psi << ',' << r << ',' << delta << ',' << fault << '\n';
      // exact for a rudder that is held over the step; the position by Simpson's rule
      const double steady = gain * delta, half = std::exp(-0.5 * dt / time);
      const double middle = psi + steady * 0.5 * dt + (r - steady) * time * (1.0 - half);
      const double after = psi + steady * dt + (r - steady) * time * (1.0 - decay);
      x += speed * dt / 6.0 * (std::cos(psi) + 4.0 * std::cos(middle) + std::cos(after));
      y += speed * dt / 6.0 * (std::sin(psi) + 4.0 * std::sin(middle) + std::sin(after));
      psi = after;
      r = steady + (r - steady) * decay;
    }
    std::printf("%s after %.2f s\n", arrived ? "arrived" : "not arrived", (k - 1) * dt);
    times.print();
  } catch (const std::exception& error) {
    std::fprintf(stderr, "course: %s\n", error.what());
    return 1;
  }
  return 0;
}
