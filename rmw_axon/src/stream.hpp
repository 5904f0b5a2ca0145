// SPDX-License-Identifier: MIT OR Apache-2.0

// Copies messages between the program's memory and the core's.

#ifndef STREAM_HPP_
#define STREAM_HPP_

#include <memory>
#include <string>

#include "cdr/plan.hpp"
#include "endpoint.hpp"

namespace rmw_axon
{

// A serialized message; a small one is on the stack.
class Stream
{
public:
  // Serializes a message. Throws Failure, with `whose` in front, if the message violates its type.
  Stream(const cdr::Plan & plan, const std::string & whose, const void * message);

  const uint8_t * data() const {return large_ ? large_.get() : small_;}
  size_t size() const {return size_;}

private:
  uint8_t small_[1024];
  std::unique_ptr<uint8_t[]> large_;
  size_t size_;
};

// Reads the taken bytes into an initialised message. Throws Failure with `whose` in front.
void read(
  const cdr::Plan & plan, const std::string & whose, const Taken & taken, void * message);

}  // namespace rmw_axon

#endif  // STREAM_HPP_
