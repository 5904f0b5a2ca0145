/* Uses every function of the C interface, wrongly too. The first argument names the case. */
#include "check.h"

#include <signal.h>
#include <sys/wait.h>

void fail(const char *file, int line, const char *what) {
    fprintf(stderr, "%s:%d: %s\n  last error: %s\n", file, line, what, axon_session_last_error());
    abort();
}

void returns(const char *file, int line, const char *call, axon_ret_t expected, axon_ret_t got,
             const char *part) {
    if (got != expected) {
        fprintf(stderr, "%s returned %d, not %d\n", call, got, expected);
        fail(file, line, call);
    }
    if (part != NULL && strstr(axon_session_last_error(), part) == NULL) {
        fprintf(stderr, "%s: the error does not say \"%s\"\n", call, part);
        fail(file, line, call);
    }
}

struct place open_place(const char *node) {
    struct place place;
    axon_session_options_t options;
    OK(axon_session_options_init(&options, AXON_SESSION_ABI));
    options.name = "ffi test";
    OK(axon_session_open(&options, &place.session));
    OK(axon_session_node_create(place.session, node, "/c", "/", &place.node));
    return place;
}

void close_place(struct place place) {
    OK(axon_session_node_destroy(place.node));
    OK(axon_session_close(place.session));
}

axon_endpoint_options_t endpoint(const char *topic) {
    axon_endpoint_options_t options;
    memset(&options, 0, sizeof options);
    options.topic = topic;
    options.type_name = "c/Text";
    return options;
}

axon_publisher_t publisher(struct place place, const char *topic) {
    axon_endpoint_options_t options = endpoint(topic);
    axon_publisher_t made;
    OK(axon_session_publisher_create(place.node, &options, &made));
    return made;
}

axon_subscription_t subscription(struct place place, const char *topic) {
    axon_endpoint_options_t options = endpoint(topic);
    axon_subscription_t made;
    OK(axon_session_subscription_create(place.node, &options, &made));
    return made;
}

uint8_t *room(void *user, size_t len) {
    struct message *message = user;
    message->len = len;
    return len <= sizeof message->bytes ? (uint8_t *)message->bytes : NULL;
}

int take(axon_subscription_t subscription, struct message *message) {
    uint8_t taken = 7;
    OK(axon_session_subscription_take(subscription, room, message, &message->info, &taken));
    CHECK(taken <= 1);
    return taken;
}

void await(struct place place, axon_subscription_t subscription) {
    axon_wait_set_t set;
    memset(&set, 0, sizeof set);
    set.subscriptions = &subscription;
    set.subscription_count = 1;
    OK(axon_session_wait(place.session, &set, PATIENCE));
}

void end_child(void) {
    raise(SIGKILL);
}

void child_ends(pid_t child) {
    int status = 0;
    CHECK(child > 0 && waitpid(child, &status, 0) == child);
    CHECK(WIFSIGNALED(status) && WTERMSIG(status) == SIGKILL);
}

int main(int argc, char **argv) {
    static const struct {
        const char *name;
        void (*run)(void);
    } cases[] = {
        {"settings", case_settings}, {"topics", case_topics}, {"loans", case_loans},
        {"waits", case_waits},       {"events", case_events}, {"misuse", case_misuse},
        {"threads", case_threads},   {"texts", case_texts},   {"fork", case_fork},
        {"services", case_services}, {"graph", case_graph}, {"log", case_log},
        {"callbacks", case_callbacks}, {"authentication", case_authentication},
        {"permissions", case_permissions},
    };
    size_t ran = 0;
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        if (argc < 2 || strcmp(argv[1], cases[i].name) == 0) {
            cases[i].run();
            printf("%s: ok\n", cases[i].name);
            ran++;
        }
    }
    return ran == 0;
}
