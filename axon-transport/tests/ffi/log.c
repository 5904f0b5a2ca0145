/* What the library says, told to the program. */
#include "check.h"

#include <pthread.h>
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
    close_place(place);
    OK(axon_session_log_set_severity(AXON_LOG_WARN));
}
