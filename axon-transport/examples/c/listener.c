#include <axon.h>
#include <stdio.h>
#include <stdlib.h>

static void check(axon_ret_t ret) {
    if (ret != AXON_RET_OK) {
        fprintf(stderr, "%s\n", axon_session_last_error());
        exit(1);
    }
}

int main(void) {
    axon_session_options_t options;
    axon_endpoint_options_t topic = {0};
    axon_session_t session;
    axon_node_t node;
    axon_subscription_t subscription;
    topic.topic = "/chatter";
    topic.type_name = "example/Text";
    check(axon_session_options_init(&options, AXON_SESSION_ABI));
    check(axon_session_open(&options, &session));
    check(axon_session_node_create(session, "listener", "/", "/", &node));
    check(axon_session_subscription_create(node, &topic, &subscription));
    for (int heard = 0; heard < 3; heard++) {
        axon_sample_t sample = {0};
        while (sample.id == 0) {
            /* A handle that is not ready is set to 0, so the wait gets a copy. */
            axon_subscription_t ready = subscription;
            axon_wait_set_t set = {0};
            const uint8_t *data;
            size_t len;
            set.subscriptions = &ready;
            set.subscription_count = 1;
            check(axon_session_wait(session, &set, AXON_WAIT_FOREVER));
            check(axon_session_subscription_take_sample(subscription, &sample, &data, &len, NULL));
            if (sample.id != 0) {
                printf("heard %.*s\n", (int)len, (const char *)data);
            }
        }
        check(axon_session_sample_release(sample));
    }
    check(axon_session_subscription_destroy(subscription));
    check(axon_session_node_destroy(node));
    check(axon_session_close(session));
    return 0;
}
