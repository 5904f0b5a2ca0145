//! The kinds of handles, and the object that each kind names.

use std::sync::Arc;

use axon_shm::{
    Sample,
    internal::{ForkToken, Made, PerProcess},
};

use super::{
    named_loan::NamedLoan,
    table::{HandleTable, Process, Unknown},
};
use crate::{
    ffi::{
        error::{
            AXON_RET_BAD_ALLOC, AXON_RET_FORKED, AXON_RET_INVALID_HANDLE, CallFailure, axon_ret_t,
        },
        memory::store,
    },
    session::{Client, Event, GuardCondition, Node, Publisher, Server, Session, Subscription},
};

/// A session: a process's membership of a domain. `axon_session_close` destroys the handle.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_session_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A node: a name in the graph to which endpoints belong.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_node_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A publisher, which sends the samples of a topic.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_publisher_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A subscription, which receives the samples of a topic.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_subscription_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A server, which answers the requests of a service.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_server_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A client, which sends requests to a service.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_client_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A guard condition. It stays set from its trigger until a wait has reported it.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_guard_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// One event of a publisher or a subscription.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_event_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A sample that was taken in place. `axon_session_sample_release` gives it back.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_sample_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// Memory that a publisher lent. The program publishes or abandons the loan.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct axon_loan_t {
    /// 0 if the handle names no object.
    pub id: u64,
}

/// A type of handle, and the type of object that it names.
pub(in crate::ffi) trait FfiHandle: Copy {
    type Object;
    const WHAT: &'static str;

    fn id(self) -> u64;
    fn of(id: u64) -> Self;
    fn table(tables: &Tables) -> &HandleTable<Self::Object>;
}

macro_rules! handles {
    ($($number:literal $table:ident: $handle:ident => $object:ty, $what:literal;)+) => {
        /// The tables of all objects that the handles of a process name.
        pub(in crate::ffi) struct Tables {
            process: Process,
            $($table: HandleTable<$object>,)+
        }

        impl Tables {
            fn new(token: ForkToken) -> Self {
                let process = Process::new(token.value());
                Self { process, $($table: HandleTable::new($number, process),)+ }
            }
        }

        /// Returns the name of a kind of object.
        fn what(kind: u8) -> &'static str {
            match kind {
                $($number => $what,)+
                _ => "nothing",
            }
        }

        $(impl FfiHandle for $handle {
            type Object = $object;
            const WHAT: &'static str = $what;

            fn id(self) -> u64 {
                self.id
            }

            fn of(id: u64) -> Self {
                Self { id }
            }

            fn table(tables: &Tables) -> &HandleTable<$object> {
                &tables.$table
            }
        })+
    };
}

handles! {
    1 sessions: axon_session_t => Session, "session";
    2 nodes: axon_node_t => Node, "node";
    3 publishers: axon_publisher_t => Publisher, "publisher";
    4 subscriptions: axon_subscription_t => Subscription, "subscription";
    5 servers: axon_server_t => Server, "server";
    6 clients: axon_client_t => Client, "client";
    7 guards: axon_guard_t => GuardCondition, "guard condition";
    8 events: axon_event_t => Event, "event";
    9 samples: axon_sample_t => Sample, "sample";
    10 loans: axon_loan_t => NamedLoan, "loan";
}

static TABLES: PerProcess<Tables> = PerProcess::new();

/// Returns this process's tables. A forked child starts with new ones.
fn current() -> Result<&'static Made<Tables>, CallFailure> {
    let none = |_: &'static Tables, _: &'static Tables| {};
    TABLES.get(Tables::new, none).map_err(|error| CallFailure::new(AXON_RET_BAD_ALLOC, error))
}

/// Returns the object that a handle names.
pub(in crate::ffi) fn named<H: FfiHandle>(handle: H) -> Result<Arc<H::Object>, CallFailure> {
    let tables = current()?;
    let found = H::table(tables.value()).get(handle.id());
    #[cfg(test)]
    crate::ffi::tests::found();
    found.map_err(|why| unknown(tables, handle, why))
}

/// Creates a handle for a new object and stores it at `out`.
///
/// # Safety
/// As for [`store`].
pub(in crate::ffi) unsafe fn give<H: FfiHandle>(
    object: H::Object,
    out: *mut H,
) -> Result<(), CallFailure> {
    let id = H::table(current()?.value()).insert(object).ok_or_else(|| {
        let what = H::WHAT;
        CallFailure::new(AXON_RET_BAD_ALLOC, format_args!("no {what} more: there are a million"))
    })?;
    // SAFETY: guaranteed by the caller.
    unsafe { store(out, H::of(id), "the place of the handle") }
}

/// Removes a handle from its table. Its object ends when no call uses it any more.
pub(in crate::ffi) fn revoke<H: FfiHandle>(handle: H) -> Result<Arc<H::Object>, CallFailure> {
    let tables = current()?;
    H::table(tables.value()).remove(handle.id()).map_err(|why| unknown(tables, handle, why))
}

/// Runs `visit` on the object that a handle names. A signal handler may call this: see
/// [`HandleTable::visit`].
pub(in crate::ffi) fn visit<H: FfiHandle>(
    handle: H,
    visit: impl FnOnce(&H::Object),
) -> Result<(), axon_ret_t> {
    let Some(tables) = TABLES.latest() else { return Err(AXON_RET_INVALID_HANDLE) };
    if tables.is_forked() {
        return Err(AXON_RET_FORKED);
    }
    H::table(tables.value()).visit(handle.id(), visit).map_err(|why| code(tables, why))
}

fn code(tables: &Made<Tables>, why: Unknown) -> axon_ret_t {
    match why {
        Unknown::Foreign(process) if tables.ancestors().any(|a| a.process == process) => {
            AXON_RET_FORKED
        }
        _ => AXON_RET_INVALID_HANDLE,
    }
}

fn unknown<H: FfiHandle>(tables: &Made<Tables>, handle: H, why: Unknown) -> CallFailure {
    let (id, what) = (handle.id(), H::WHAT);
    let code = code(tables, why);
    let text = match why {
        Unknown::Null => format!("the handle of the {what} is 0"),
        Unknown::OtherKind(kind) => {
            let other = self::what(kind);
            format!("the handle {id:#x} names a {other} where a {what} is expected")
        }
        Unknown::Foreign(_) if code == AXON_RET_FORKED => format!(
            "the {what} belongs to the process of which this one is a fork: \
             open a session here"
        ),
        Unknown::Foreign(_) | Unknown::Gone => {
            format!("the handle {id:#x} names no {what}: it was destroyed")
        }
    };
    CallFailure::new(code, text)
}
