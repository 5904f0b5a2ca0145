// SPDX-License-Identifier: MIT OR Apache-2.0

#include "stream.hpp"

#include "cdr/codec.hpp"
#include "error.hpp"

namespace rmw_axon
{

Stream::Stream(const cdr::Plan & plan, const std::string & whose, const void * message)
{
  try {
    size_ = cdr::encoded_size(plan, message);
    if (size_ > sizeof(small_)) {
      large_.reset(new uint8_t[size_]);
    }
    cdr::encode(plan, message, large_ ? large_.get() : small_, size_);
  } catch (const cdr::Error & error) {
    throw Failure(RMW_RET_ERROR, whose + ", " + plan.type + ": " + error.what());
  }
}

void read(
  const cdr::Plan & plan, const std::string & whose, const Taken & taken, void * message)
{
  try {
    cdr::decode(plan, taken.data, taken.size, message);
  } catch (const cdr::Error & error) {
    throw Failure(RMW_RET_ERROR, whose + ": a message that is no " + plan.type + ": " + error.what());
  }
}

}  // namespace rmw_axon
