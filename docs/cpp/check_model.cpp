// SPDX-License-Identifier: Apache-2.0
// check_model MODEL.JSON INPUT OUTPUT [AGE]: may a controller be tuned by this model of one input
// and one output? AGE is that of the window [s], 0 unless given. Exit code 0: yes, 3: no.
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <sstream>

#include "model_message.hpp"

int main(int argc, char ** argv)
{
  if (argc < 4) {
    std::cerr << "usage: check_model MODEL.JSON INPUT OUTPUT [AGE]\n";
    return 2;
  }
  std::ifstream file(argv[1]);
  std::stringstream text;
  text << file.rdbuf();
  try {
    const auto model = ctsid_example::decode(text.str());
    ctsid_example::Limits limits;
    limits.inputs = {argv[2]};
    limits.outputs = {argv[3]};
    const double age = argc > 4 ? std::atof(argv[4]) : 0.0;
    const auto why = ctsid_example::objection(
      model, model.end_ns + static_cast<std::int64_t>(1e9 * age), limits);
    if (!why.empty()) {
      std::cout << "Refused: " << why << '\n';
      return 3;
    }
    std::cout.precision(17);
    std::cout << "Accepted\n";
    for (const auto & pole : model.poles) {
      std::cout << pole.real() << ' ' << pole.imag() << '\n';
    }
    return 0;
  } catch (const std::runtime_error & error) {
    std::cerr << argv[1] << ": " << error.what() << '\n';
    return 1;
  }
}
