#include <axon.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

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
    axon_publisher_t publisher;
    topic.topic = "/chatter";
    topic.type_name = "example/Text";
    check(axon_session_options_init(&options, AXON_SESSION_ABI));
    check(axon_session_open(&options, &session));
    check(axon_session_node_create(session, "talker", "/", "/", &node));
    check(axon_session_publisher_create(node, &topic, &publisher));
    for (int number = 1;; number++) {
        char text[32];
        int len = snprintf(text, sizeof text, "hello %d", number);
        check(axon_session_publisher_publish(publisher, (uint8_t *)text, (size_t)len, AXON_TIME_NOW,
                                             NULL));
        usleep(100000);
    }
}
