// SPDX-License-Identifier: MIT OR Apache-2.0

// Messages to CDR streams and back: plain CDR (OMG DDSI-RTPS 2.5, clause 10.2; Common Data Representation,
// CORBA 3.3 part 2, clause 9.3) behind its encapsulation header of four bytes. Written in the machine's
// byte order, read in either.
//
// A stream is not trusted and may change while it is read, because its sender may write to its memory. So
// every length is read once and checked before it is used, no byte outside the stream is touched, and nothing
// is allocated for items that the rest of the stream could not hold.

#ifndef CDR__CODEC_HPP_
#define CDR__CODEC_HPP_

#include <cstddef>
#include <cstdint>

#include "cdr/plan.hpp"

namespace rmw_axon::cdr
{

// Bytes before the body. The body is aligned within itself, from 0.
inline constexpr size_t HEADER = 4;

// Returns how many bytes `encode` writes. Throws Error for a message that its type does not allow.
size_t encoded_size(const Plan & plan, const void * message);

// Writes the stream of `message`, at most `capacity` bytes, and returns how many.
// Throws Error where the type does not allow the message, or it does not fit.
size_t encode(const Plan & plan, const void * message, uint8_t * out, size_t capacity);

// Reads a stream into an initialised message. Throws Error if it is not a stream of the type; the message
// then stays initialised, with the part that was read. Bytes after the message are ignored.
void decode(const Plan & plan, const uint8_t * stream, size_t size, void * message);

// Writes the encapsulation header of a stream in this machine's byte order.
void write_header(uint8_t * out);

// For a plain type: returns whether a stream's body can be read as a message in place. It must be in this
// machine's byte order, long enough, and without a bool that is neither true nor false.
bool readable_in_place(const Plan & plan, const uint8_t * stream, size_t size);

}  // namespace rmw_axon::cdr

#endif  // CDR__CODEC_HPP_
