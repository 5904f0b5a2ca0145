// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef TAKE_HPP_
#define TAKE_HPP_

#include "endpoint.hpp"

namespace rmw_axon
{

// Returns a loan of a subscription: a sample, or a message on the heap.
void end_loan(const Subscription & subscription, void * message, axon_sample_t sample);

}  // namespace rmw_axon

#endif  // TAKE_HPP_
