//! Futures that wait for messages: for any runtime, and without a thread of their own.
//!
//! The session's control thread listens on the doorbell for them, as it does for callbacks, and wakes the tasks
//! whose endpoint has a message. A task does four things before it sleeps, in this order:
//!
//! 1. It has the control thread [listen](listening::Listener).
//! 2. It puts its waker in the endpoint's [`Wakers`].
//! 3. It [arms](listening::Listening::arm) a new ticket of the doorbell.
//! 4. It looks for a message once more.
//!
//! No wake-up is lost. A writer publishes and then looks for an armed ticket. The doorbell's own protocol guarantees
//! that either the task's look after the arming sees the publication, or the writer sees the ticket. So if step 4
//! does not find a message, its writer finds the ticket of step 3, or a later one. If the ticket is still armed, the
//! writer rings. The control thread takes each ring and then looks at the wakers, and step 2 came before the ring.
//! If another message has used the ticket up, the control thread still has to answer that message's ring: it takes
//! the ring, finds the waker of step 2, and checks the waker's endpoint for a message. Either it sees the message,
//! or it arms a ticket before it looks again. It repeats this while a waker is left whose endpoint has no message.
//!
//! Wakers are woken and dropped under no lock: either may run arbitrary code, and may even drop the endpoint.

mod calls;
mod listening;
mod receive;
mod wakers;

use super::{state::SessionShared, subscription::SubscriptionInner};

pub use calls::CallError;
pub(in crate::session) use calls::Calls;
pub(in crate::session) use listening::Listening;
pub use receive::Messages;
pub(in crate::session) use wakers::Wakers;

impl SubscriptionInner {
    /// For the control thread: wakes the tasks for which something came. Whether some still wait, so that
    /// whatever comes next must ring.
    pub(in crate::session) fn wake_tasks(&self, shared: &SessionShared) -> bool {
        let calls = self.calls.collect(self, shared);
        let receivers = self.wakers.wake_if(|| self.has_data());
        calls || receivers
    }
}
