// SPDX-License-Identifier: MIT OR Apache-2.0

// Internal errors are exceptions. At the border of each rmw function they become return codes and rmw's error
// string. The string names the topic and node, and the reason.

#ifndef ERROR_HPP_
#define ERROR_HPP_

#include <new>
#include <stdexcept>
#include <string>

#include "axon.h"
#include "cdr/plan.hpp"
#include "rmw/ret_types.h"

namespace rmw_axon
{

// The result of rmw_get_implementation_identifier(), which is compared by address.
extern const char * const identifier;

class Failure : public std::runtime_error
{
public:
  Failure(rmw_ret_t code, const std::string & text)
  : std::runtime_error(text), code(code) {}

  const rmw_ret_t code;
};

// Throws the core's error of its last call in this thread, unless that call succeeded.
void check(axon_ret_t returned);

// Checks an argument that may not be null, named as in rmw's headers.
template<typename Pointer>
void require(Pointer pointer, const char * name)
{
  if (pointer == nullptr) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, std::string(name) + " is null");
  }
}

// An object that another middleware made cannot be used here.
void require_ours(const char * implementation_identifier, const char * name);

template<typename Object>
void require_object(const Object * object, const char * name)
{
  require(object, name);
  require_ours(object->implementation_identifier, name);
}

// Sets rmw's error string, in place of one that is there.
void set_error(const char * text) noexcept;

// Runs the body of a function that returns a code.
template<typename Body>
rmw_ret_t guarded(Body body) noexcept
{
  try {
    body();
    return RMW_RET_OK;
  } catch (const Failure & failure) {
    // A timeout is a result, not an error.
    if (failure.code != RMW_RET_TIMEOUT) {
      set_error(failure.what());
    }
    return failure.code;
  } catch (const std::bad_alloc &) {
    set_error("out of memory");
    return RMW_RET_BAD_ALLOC;
  } catch (const std::exception & error) {
    set_error(error.what());
    return RMW_RET_ERROR;
  }
}

// Runs the body of a function that returns a pointer: null where it fails.
template<typename Body>
auto guarded_pointer(Body body) noexcept -> decltype(body())
{
  decltype(body()) made = nullptr;
  const auto into = [&] {made = body();};
  return guarded(into) == RMW_RET_OK ? made : nullptr;
}

}  // namespace rmw_axon

#endif  // ERROR_HPP_
