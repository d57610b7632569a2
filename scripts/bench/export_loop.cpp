// Times an exported TorchScript module in C++: prints the first call and the median step in microseconds of CPU time.
#include <cstdlib>
#include <ctime>

#include "../../examples/autopilot_cpp/stepping.hpp"

static double now() {
  timespec at;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &at);
  return 1e6 * static_cast<double>(at.tv_sec) + 1e-3 * static_cast<double>(at.tv_nsec);
}

int main(int argc, char** argv) {
  if (argc != 4) return 2;
  torch::InferenceMode guard;
  torch::jit::Module module = load_for_steps(argv[1]);
  torch::Tensor x = torch::zeros({1, 6}), w = torch::full({1, std::atoi(argv[2])}, 5.0);
  torch::Tensor s = module.run_method("initial_state", 1).toTensor();
  x[0][3] = 1.0;
  auto step = module.get_method("step");
  std::vector<double> taken;
  for (int k = 0; k < std::atoi(argv[3]); ++k) {
    const double begun = now();
    auto out = step({x, w, s}).toTuple();
    taken.push_back(now() - begun);
    s = out->elements()[1].toTensor();
  }
  const double first = taken.front();
  std::nth_element(taken.begin(), taken.begin() + static_cast<std::ptrdiff_t>(taken.size() / 2), taken.end());
  std::printf("%.3f %.3f\n", first, taken[taken.size() / 2]);
  return 0;
}
