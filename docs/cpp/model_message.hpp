// SPDX-License-Identifier: Apache-2.0
// A model of ctsid from the text of a message of ~/model, or of a file model.json, and whether a
// controller may be tuned by it. Needs nlohmann/json.hpp and no ROS.
#pragma once

#include <algorithm>
#include <cmath>
#include <complex>
#include <cstdint>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

namespace ctsid_example
{

using Matrix = std::vector<std::vector<double>>;  // rows

struct Model
{
  std::string grade, reason;  // GOOD, WEAK or REJECT, and a sentence
  std::int64_t start_ns = 0, end_ns = 0;
  std::vector<std::string> inputs, outputs;
  Matrix A, B, C, D, K;  // empty if REJECT
  std::vector<double> x_trim, y_trim, delay;  // delay: of each input [s]
  std::vector<double> timeout;  // each input counts as 0 so long after a message [s]; 0: never
  // Of each input so much moves nothing, acts at most, is play, and changes at most [unit, unit/s];
  // 0: none.
  std::vector<double> dead_zone, limit, backlash, rate_limit;
  std::vector<std::complex<double>> poles;  // [rad/s]
  std::vector<double> pole_std, fit, held_out_fit, fresh_fit;  // NaN: not known
  std::int64_t realisation = 0;  // another number: states begin anew
};

struct Limits
{
  std::vector<std::string> inputs, outputs;  // wanted, in this order
  double vague = 0.2;       // largest pole_std over the size of the pole
  double fit = 70.0;        // least fit, on the window and held out [%]
  double fresh_fit = 50.0;  // least fit of the model before on the new data [%]
  double age = 5.0;         // longest time since the end of the window [s]
};

// In the JSON null is a number that is not known, and infinite ones are words.
inline double number(const nlohmann::json & value)
{
  if (value.is_null()) {
    return std::numeric_limits<double>::quiet_NaN();
  }
  if (value.is_string()) {
    const double infinity = std::numeric_limits<double>::infinity();
    return value.get<std::string>() == "-Infinity" ? -infinity : infinity;
  }
  return value.get<double>();
}

inline std::vector<double> numbers(const nlohmann::json & list)
{
  std::vector<double> found;
  for (const auto & value : list) {
    found.push_back(number(value));
  }
  return found;
}

// Throws std::runtime_error if the text is no model, or of a format that this code does not know.
inline Model decode(const std::string & text)
{
  try {
    const auto json = nlohmann::json::parse(text);
    if (json.at("format") != "ctsid-model" || json.at("version") != 2) {
      throw std::runtime_error("it is not a model of ctsid in version 2 of the format");
    }
    Model found;
    found.grade = json.at("verdict").at("grade").get<std::string>();
    found.reason = json.at("verdict").at("reason").get<std::string>();
    found.start_ns = json.at("start_ns").get<std::int64_t>();
    found.end_ns = json.at("end_ns").get<std::int64_t>();
    found.pole_std = numbers(json.at("pole_std"));
    found.fit = numbers(json.at("fit"));
    found.held_out_fit = numbers(json.at("held_out_fit"));
    const auto & metadata = json.at("metadata");  // of a file these two may be missing
    found.fresh_fit = numbers(metadata.value("fresh_fit", nlohmann::json::array()));
    found.realisation = metadata.value("realisation", std::int64_t{0});
    const auto & model = json.at("model");
    if (model.is_null()) {
      return found;  // REJECT
    }
    found.inputs = model.at("input_names").get<std::vector<std::string>>();
    found.outputs = model.at("output_names").get<std::vector<std::string>>();
    found.A = model.at("A").get<Matrix>();
    found.B = model.at("B").get<Matrix>();
    found.C = model.at("C").get<Matrix>();
    found.D = model.at("D").get<Matrix>();
    found.K = model.at("K").get<Matrix>();
    found.x_trim = model.at("x_trim").get<std::vector<double>>();
    found.y_trim = model.at("y_trim").get<std::vector<double>>();
    found.delay = model.at("delay").get<std::vector<double>>();
    const std::vector<double> none(found.delay.size(), 0.0);
    found.timeout = model.value("timeout", none);
    found.dead_zone = model.value("dead_zone", none);
    found.limit = model.value("limit", none);
    found.backlash = model.value("backlash", none);
    found.rate_limit = model.value("rate_limit", none);
    for (const auto & pole : model.at("poles")) {
      found.poles.emplace_back(number(pole.at("re")), number(pole.at("im")));
    }
    return found;
  } catch (const nlohmann::json::exception & error) {
    throw std::runtime_error(std::string("it is not a model of ctsid: ") + error.what());
  }
}

// Returns why no controller should be tuned by a model, as a sentence; "" if one may.
inline std::string objection(const Model & model, std::int64_t now_ns, const Limits & limits)
{
  std::ostringstream why;
  if (model.grade != "GOOD" || model.A.empty()) {
    why << model.grade << ": " << model.reason;
    return why.str();
  }
  if (model.inputs != limits.inputs || model.outputs != limits.outputs) {
    return "the model has other inputs or outputs than wanted, or in another order";
  }
  const double age = 1e-9 * static_cast<double>(now_ns - model.end_ns);
  if (!(age >= -1.0 && age <= limits.age)) {
    why << "its window ended " << age << " s ago";
    return why.str();
  }
  if (model.pole_std.size() != model.poles.size()) {
    return "how sure its poles are is not known";
  }
  // A pole slower than the window can tell is measured by the window instead.
  const double slowest = 2e9 * std::acos(-1.0) / static_cast<double>(model.end_ns - model.start_ns);
  for (std::size_t i = 0; i < model.poles.size(); ++i) {
    const double size = std::max(std::abs(model.poles[i]), slowest);
    if (!(model.pole_std[i] <= limits.vague * size)) {  // so that NaN is refused
      why << "the pole " << model.poles[i] << " rad/s has a standard deviation of " <<
        model.pole_std[i];
      return why.str();
    }
  }
  const auto low = [&why](const std::vector<double> & fits, double least, const char * name) {
      for (const double fit : fits) {
        if (fit < least) {  // one that is not known is no fault
          why << "the " << name << " is " << fit << " %; wanted are " << least << " %";
          return true;
        }
      }
      return false;
    };
  if (low(model.fit, limits.fit, "fit on the window") ||
    low(model.held_out_fit, limits.fit, "fit on data held out") ||
    low(model.fresh_fit, limits.fresh_fit, "fit of the model before on the data since"))
  {
    return why.str();
  }
  return "";
}

}  // namespace ctsid_example
