/* What the cases of the C interface's test have in common. */
#ifndef CHECK_H
#define CHECK_H

#include <axon.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>

#define SECOND INT64_C(1000000000)
/* Long enough for a loaded machine; what works does not wait for it. */
#define PATIENCE (60 * SECOND)

#define CHECK(condition)                                                                         \
    do {                                                                                         \
        if (!(condition)) {                                                                      \
            fail(__FILE__, __LINE__, #condition);                                                \
        }                                                                                        \
    } while (0)

/* The call returns `expected`; if that is a failure, the text of the error holds `part`. */
#define RETURNS(expected, call, part) returns(__FILE__, __LINE__, #call, (expected), (call), (part))
#define OK(call) returns(__FILE__, __LINE__, #call, AXON_RET_OK, (call), NULL)
#define NO_HANDLE(call) RETURNS(AXON_RET_INVALID_HANDLE, call, "")

void fail(const char *file, int line, const char *what);
void returns(const char *file, int line, const char *call, axon_ret_t expected, axon_ret_t got,
             const char *part);

/* A session by the environment, and a node in it. */
struct place {
    axon_session_t session;
    axon_node_t node;
};
struct place open_place(const char *node);
void close_place(struct place place);

axon_endpoint_options_t endpoint(const char *topic);
axon_publisher_t publisher(struct place place, const char *topic);
axon_subscription_t subscription(struct place place, const char *topic);

/* A message that was taken, in room of its own. */
struct message {
    char bytes[8192];
    size_t len;
    axon_message_info_t info;
};
/* Room in a struct message. */
uint8_t *room(void *user, size_t len);
/* Whether there was one. */
int take(axon_subscription_t subscription, struct message *message);
/* Waits until there is something to take. */
void await(struct place place, axon_subscription_t subscription);

/* Whether to try what a forked child does. Not with the address sanitizer: those of older compilers do not
 * make their allocator ready for a fork, so that a child may wait for ever for a lock which it holds. */
#ifndef FORKS
#define FORKS 1
#endif

/* A handle that names nothing any more, of any kind. */
#define STALE UINT64_C(0x123456789abcdef)

/* How a forked child ends that did what it should. Not by _exit, at which valgrind looks for leaks: what
 * other threads of its parent alone reach is lost to it. */
void end_child(void);
/* Waits for that. */
void child_ends(pid_t child);

/* The cases. */
void case_authentication(void);
void case_permissions(void);
void case_settings(void);
void case_topics(void);
void case_loans(void);
void case_waits(void);
void case_events(void);
void case_misuse(void);
void case_threads(void);
void case_texts(void);
void case_fork(void);
void case_services(void);
void case_graph(void);
void case_log(void);
void case_callbacks(void);

#endif
