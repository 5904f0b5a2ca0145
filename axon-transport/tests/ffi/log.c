/* What the library says, told to the program. */
#include "check.h"

#include <pthread.h>
#include <stdatomic.h>
#include <sys/wait.h>
#include <unistd.h>

struct heard {
    pthread_mutex_t lock;
    unsigned lines;
    uint32_t severest;
    char last[256];
};

static struct heard heard = {PTHREAD_MUTEX_INITIALIZER, 0, 0, ""};

static void hear(const void *user, uint32_t severity, const char *part, const char *text) {
    CHECK(user == &heard);
    CHECK(part != NULL && text != NULL);
    /* What it says because of this is not told, or this would never end. */
    RETURNS(AXON_RET_ERROR, axon_session_log_set_callback(NULL, NULL), "within");
    pthread_mutex_lock(&heard.lock);
    heard.lines++;
    if (severity > heard.severest) {
        heard.severest = severity;
    }
    snprintf(heard.last, sizeof heard.last, "%s: %s", part, text);
    pthread_mutex_unlock(&heard.lock);
}

static unsigned lines(void) {
    pthread_mutex_lock(&heard.lock);
    unsigned lines = heard.lines;
    pthread_mutex_unlock(&heard.lock);
    return lines;
}

/* A subscription that ends while it is received from is worth a line for who looks for faults. */
static void say_something(struct place place) {
    axon_publisher_t talker = publisher(place, "/said");
    axon_subscription_t listener = subscription(place, "/said");
    OK(axon_session_subscription_wait_matched(listener, 1, SECOND * 60));
    OK(axon_session_publisher_destroy(talker));
    usleep(2000);
    OK(axon_session_subscription_destroy(listener));
}

/* What a program that is not ready to hear holds. */
static pthread_mutex_t gate = PTHREAD_MUTEX_INITIALIZER;
static atomic_int waits_at_gate;

static void wait_at_gate(const void *user, uint32_t severity, const char *part, const char *text) {
    (void)user, (void)severity, (void)part, (void)text;
    atomic_store(&waits_at_gate, 1);
    pthread_mutex_lock(&gate);
    pthread_mutex_unlock(&gate);
}

/* While a callback is under way. */
static void set_again_and_in_a_fork(struct place place) {
    pthread_mutex_lock(&gate);
    OK(axon_session_log_set_callback(wait_at_gate, NULL));
    for (int round = 0; !atomic_load(&waits_at_gate); round++) {
        CHECK(round < 1000);
        say_something(place);
    }
    /* That it waits for what this thread holds is in nobody's way. */
    OK(axon_session_log_set_callback(wait_at_gate, NULL));
    pid_t child = fork();
    if (child == 0) {
        /* It would wait for ever for a call that only its parent makes. */
        alarm(60);
        OK(axon_session_log_set_callback(hear, &heard));
        OK(axon_session_log_set_callback(NULL, NULL));
        end_child();
    }
    child_ends(child);
    pthread_mutex_unlock(&gate);
    OK(axon_session_log_set_callback(NULL, NULL));
}

static atomic_int child_has_begun;
static atomic_int child_has_ended;

/* A child has a log of its own, though it is within its parent's callback. */
static void fork_within(const void *user, uint32_t severity, const char *part, const char *text) {
    (void)user, (void)severity, (void)part, (void)text;
    static int forked;
    if (forked++ > 0) {
        return;
    }
    atomic_store(&child_has_begun, 1);
    pid_t child = fork();
    if (child == 0) {
        pthread_mutex_init(&heard.lock, NULL);
        heard.lines = 0;
        OK(axon_session_log_set_callback(hear, &heard));
        struct place place = open_place("child");
        for (int round = 0; lines() == 0; round++) {
            CHECK(round < 1000);
            say_something(place);
        }
        end_child();
    }
    child_ends(child);
    atomic_store(&child_has_ended, 1);
}

static void fork_within_a_callback(struct place place) {
    OK(axon_session_log_set_callback(fork_within, NULL));
    for (int round = 0; !atomic_load(&child_has_begun); round++) {
        CHECK(round < 1000);
        say_something(place);
    }
    /* Under valgrind it ends slowly: all that is mapped is searched. */
    for (int round = 0; !atomic_load(&child_has_ended); round++) {
        CHECK(round < 60 * 1000);
        usleep(1000);
    }
    OK(axon_session_log_set_callback(NULL, NULL));
}

void case_log(void) {
    OK(axon_session_log_set_severity(AXON_LOG_DEBUG));
    OK(axon_session_log_set_callback(hear, &heard));
    struct place place = open_place("log");
    for (int round = 0; lines() == 0; round++) {
        CHECK(round < 1000);
        say_something(place);
    }
    CHECK(strstr(heard.last, "axon_transport") != NULL);
    CHECK(heard.severest < AXON_LOG_ERROR);
    /* Nothing so severe happens here. */
    OK(axon_session_log_set_severity(AXON_LOG_ERROR));
    unsigned before = lines();
    say_something(place);
    CHECK(lines() <= before + 1);
    OK(axon_session_log_set_severity(AXON_LOG_DEBUG));
    OK(axon_session_log_set_callback(NULL, NULL));
    before = lines();
    say_something(place);
    CHECK(lines() == before);
    if (FORKS) {
        set_again_and_in_a_fork(place);
        fork_within_a_callback(place);
    }
    close_place(place);
    OK(axon_session_log_set_severity(AXON_LOG_WARN));
}
