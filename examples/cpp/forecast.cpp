// Runs a forecaster that `epo export format=aoti` compiled: prints forecasts and latency, without Python.
//
//   forecast FORECASTER.pt2 SCENES.pt [FORECASTS.pt]
//
// SCENES.pt is a dictionary of tensors by name, as torch.save writes it; FORECASTS.pt gets a tuple of the outputs.

#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/torch.h>

#include <algorithm>
#include <chrono>
#include <fstream>
#include <iostream>
#include <iterator>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

constexpr int kCalls = 101;

using Tensors = std::vector<torch::Tensor>;

std::vector<std::string> split(const std::string& names) {
  std::istringstream stream(names);
  return {std::istream_iterator<std::string>(stream), {}};
}

c10::Dict<c10::IValue, c10::IValue> read(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error("cannot open " + path);
  return torch::pickle_load({std::istreambuf_iterator<char>(file), {}}).toGenericDict();
}

void write(const std::string& path, const Tensors& values) {
  const auto tuple = c10::ivalue::Tuple::create(std::vector<c10::IValue>(values.begin(), values.end()));
  const std::vector<char> bytes = torch::pickle_save(tuple);
  std::ofstream(path, std::ios::binary).write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

double milliseconds(torch::inductor::AOTIModelPackageLoader& forecaster, const Tensors& inputs) {
  const auto start = std::chrono::steady_clock::now();
  forecaster.run(inputs);
  return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
}

}  // namespace

int main(int count, char** words) try {
  if (count < 3) throw std::runtime_error("usage: forecast FORECASTER.pt2 SCENES.pt [FORECASTS.pt]");
  const c10::InferenceMode guard;
  torch::set_num_threads(1);
  torch::inductor::AOTIModelPackageLoader forecaster(words[1], "model", /*run_single_threaded=*/true);
  auto metadata = forecaster.get_metadata();  // what `epo export` says about inputs and outputs
  const auto scenes = read(words[2]);
  Tensors inputs;
  for (const auto& name : split(metadata.at("inputs"))) inputs.push_back(scenes.at(name).toTensor());
  const std::vector<std::string> names = split(metadata.at("outputs"));

  const Tensors outputs = forecaster.run(inputs);
  if (count > 3) write(words[3], outputs);
  for (size_t index = 0; index < names.size(); ++index)
    std::cout << names[index] << ' ' << outputs[index].sizes() << '\n';
  const torch::Tensor& states = outputs.at(0);  // [B, M, N, K, 4]: x, y [m], heading [rad], speed [m/s]
  const int64_t mode = outputs.at(1)[0].argmax().item<int64_t>();
  std::cout << "last positions of the agents of scene 0 in its most likely mode [m]:\n"
            << states[0][mode].select(1, -1).slice(-1, 0, 2) << '\n';

  std::vector<double> times;
  for (int call = 0; call < kCalls; ++call) times.push_back(milliseconds(forecaster, inputs));
  std::sort(times.begin(), times.end());
  std::cout << "one call for " << states.size(0) << " scene(s), " << kCalls << " times: " << times[0] << " ms at least, "
            << times[kCalls / 2] << " ms in the median\n";
} catch (const c10::Error& error) {
  std::cerr << error.what_without_backtrace() << '\n';
  return 1;
} catch (const std::exception& error) {
  std::cerr << error.what() << '\n';
  return 1;
}
