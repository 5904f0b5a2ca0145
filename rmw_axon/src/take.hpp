// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef TAKE_HPP_
#define TAKE_HPP_

#include "endpoint.hpp"

namespace rmw_axon
{

// Gives back what a subscription lent: a sample, or a message of the heap.
void end_loan(const Subscription & subscription, void * message, axon_sample_t sample);

}  // namespace rmw_axon

#endif  // TAKE_HPP_
