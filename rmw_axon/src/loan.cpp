// SPDX-License-Identifier: MIT OR Apache-2.0

// Messages that a publisher lends. The program writes them in the memory that the publisher's subscriptions
// read. The memory contains a stream's header and then the message itself, which is the stream's body.

#include <string>

#include "cdr/codec.hpp"
#include "endpoint.hpp"
#include "error.hpp"
#include "rmw/rmw.h"
#include "stream.hpp"
#include "trace.hpp"

namespace rmw_axon
{

Publisher::~Publisher()
{
  // Loans that the program still has end with the publisher: rmw requires the program to return them before.
  for (const auto & [message, loan] : loans) {
    plan.fini(message);
    axon_session_loan_abandon(loan);
  }
  axon_session_publisher_destroy(handle);
}

namespace
{

void require_plain(const Publisher & publisher)
{
  if (!publisher.plan.plain) {
    throw Failure(
            RMW_RET_UNSUPPORTED, publisher.label + ": a " + publisher.plan.type +
            " is not of a fixed size and cannot be lent");
  }
}

// Removes a loan from the list of the program's loans.
axon_loan_t take_off(Publisher & publisher, void * message)
{
  const std::lock_guard<std::mutex> lock(publisher.loans_mutex);
  const auto found = publisher.loans.find(message);
  if (found == publisher.loans.end()) {
    throw Failure(
            RMW_RET_INVALID_ARGUMENT, publisher.label + ": the message is not lent");
  }
  const axon_loan_t loan = found->second;
  publisher.loans.erase(found);
  return loan;
}

void * borrow(Publisher & publisher)
{
  axon_loan_t loan{};
  uint8_t * stream = nullptr;
  const size_t size = cdr::HEADER + publisher.plan.size_of;
  check(axon_session_publisher_loan(publisher.handle, cdr::HEADER, size, &loan, &stream));
  void * message = stream + cdr::HEADER;
  try {
    publisher.plan.init(message);
    const std::lock_guard<std::mutex> lock(publisher.loans_mutex);
    publisher.loans.emplace(message, loan);
  } catch (...) {
    axon_session_loan_abandon(loan);
    throw;
  }
  return message;
}

void publish(Publisher & publisher, void * message, axon_loan_t loan)
{
  cdr::write_header(static_cast<uint8_t *>(message) - cdr::HEADER);
  const size_t size = cdr::HEADER + publisher.plan.size_of;
  check(axon_session_loan_publish(loan, size, trace::publish(publisher, message), nullptr));
}

}  // namespace

}  // namespace rmw_axon

using rmw_axon::Failure;
using rmw_axon::Publisher;
using rmw_axon::check;
using rmw_axon::guarded;
using rmw_axon::publisher_of;
using rmw_axon::require;

extern "C" {

rmw_ret_t rmw_borrow_loaned_message(
  const rmw_publisher_t * publisher, const rosidl_message_type_support_t * type_support,
  void ** ros_message)
{
  return guarded(
    [&] {
      Publisher & of = publisher_of(publisher);
      rmw_axon::require_plain(of);
      require(type_support, "type_support");
      require(ros_message, "ros_message");
      if (*ros_message != nullptr) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "*ros_message is not null");
      }
      *ros_message = rmw_axon::borrow(of);
    });
}

rmw_ret_t rmw_return_loaned_message_from_publisher(
  const rmw_publisher_t * publisher, void * loaned_message)
{
  return guarded(
    [&] {
      Publisher & of = publisher_of(publisher);
      rmw_axon::require_plain(of);
      require(loaned_message, "loaned_message");
      const axon_loan_t loan = rmw_axon::take_off(of, loaned_message);
      of.plan.fini(loaned_message);
      axon_session_loan_abandon(loan);
    });
}

rmw_ret_t rmw_publish_loaned_message(
  const rmw_publisher_t * publisher, void * ros_message, rmw_publisher_allocation_t *)
{
  return guarded(
    [&] {
      Publisher & of = publisher_of(publisher);
      rmw_axon::require_plain(of);
      require(ros_message, "ros_message");
      const axon_loan_t loan = rmw_axon::take_off(of, ros_message);
      rmw_axon::publish(of, ros_message, loan);
    });
}

}
