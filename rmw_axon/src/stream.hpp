// SPDX-License-Identifier: MIT OR Apache-2.0

// Messages between the program's memory and the core's.

#ifndef STREAM_HPP_
#define STREAM_HPP_

#include <memory>
#include <string>

#include "cdr/plan.hpp"
#include "endpoint.hpp"

namespace rmw_axon
{

// A message serialized: on the stack where it is small.
class Stream
{
public:
  // Throws Failure with `whose` in front where its type does not allow the message.
  Stream(const cdr::Plan & plan, const std::string & whose, const void * message);

  const uint8_t * data() const {return large_ ? large_.get() : small_;}
  size_t size() const {return size_;}

private:
  uint8_t small_[1024];
  std::unique_ptr<uint8_t[]> large_;
  size_t size_;
};

// Reads what was taken into an initialised message. Throws Failure with `whose` in front.
void read(
  const cdr::Plan & plan, const std::string & whose, const Taken & taken, void * message);

}  // namespace rmw_axon

#endif  // STREAM_HPP_
