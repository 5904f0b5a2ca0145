//! The names that ROS 2 gives to the topics and services of actions, parameters and lifecycle nodes.

use super::{TopicPattern, Verb};

/// Services of an action, appended to its name.
pub const ACTION_SERVICES: [&str; 3] =
    ["_action/send_goal", "_action/cancel_goal", "_action/get_result"];
/// Topics of an action, appended to its name.
pub const ACTION_TOPICS: [&str; 2] = ["_action/feedback", "_action/status"];
/// Services of a node's parameters, appended to the node's name.
pub const PARAMETER_SERVICES: [&str; 6] = [
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
];
/// The topic on which nodes report changes of parameters.
pub const PARAMETER_EVENTS: &str = "/parameter_events";
/// Services of a lifecycle node, appended to its name.
pub const LIFECYCLE_SERVICES: [&str; 5] = [
    "change_state",
    "get_available_states",
    "get_available_transitions",
    "get_state",
    "get_transition_graph",
];
/// The topic of a lifecycle node, appended to its name.
pub const LIFECYCLE_TOPIC: &str = "transition_event";

fn below<'a>(
    name: &'a TopicPattern,
    verb: Verb,
    rests: &'static [&'static str],
) -> impl Iterator<Item = (Verb, TopicPattern)> + 'a {
    rests.iter().map(move |rest| (verb, name.below(rest)))
}

/// Returns the uses by the client of an action.
pub(super) fn act(name: &TopicPattern) -> Vec<(Verb, TopicPattern)> {
    let services = below(name, Verb::Call, &ACTION_SERVICES);
    services.chain(below(name, Verb::Subscribe, &ACTION_TOPICS)).collect()
}

/// Returns the uses by the server of a service, and by the server of an action.
pub(super) fn serve(name: &TopicPattern) -> Vec<(Verb, TopicPattern)> {
    let services = below(name, Verb::Serve, &ACTION_SERVICES);
    let topics = below(name, Verb::Publish, &ACTION_TOPICS);
    [(Verb::Serve, name.clone())].into_iter().chain(services).chain(topics).collect()
}

/// Returns the uses by a tool that reads and sets the parameters of a node. All nodes share the topic of changes.
pub(super) fn parameters(node: &TopicPattern) -> Vec<(Verb, TopicPattern)> {
    let events = TopicPattern::new(PARAMETER_EVENTS).map(|events| (Verb::Subscribe, events));
    let own = parameter_services(node).into_iter();
    own.chain(events).chain([(Verb::See, node.clone())]).collect()
}

/// Returns the part of [`parameters`] that concerns only this node. A `[[deny]]` applies to no more, for two reasons:
/// the topic of changes also carries the changes of other nodes, and a topic may have the node's name.
pub(super) fn parameter_services(node: &TopicPattern) -> Vec<(Verb, TopicPattern)> {
    below(node, Verb::Call, &PARAMETER_SERVICES).collect()
}

/// Returns the uses by a manager of lifecycle nodes.
pub(super) fn lifecycle(node: &TopicPattern) -> Vec<(Verb, TopicPattern)> {
    lifecycle_parts(node).into_iter().chain([(Verb::See, node.clone())]).collect()
}

/// Returns the part of [`lifecycle`] that a `[[deny]]` applies to.
pub(super) fn lifecycle_parts(node: &TopicPattern) -> Vec<(Verb, TopicPattern)> {
    let services = below(node, Verb::Call, &LIFECYCLE_SERVICES);
    services.chain(below(node, Verb::Subscribe, &[LIFECYCLE_TOPIC])).collect()
}
