//! Plans for faults: for which requests, how often and how likely they happen. Also the queue of
//! plans at a KME.

use std::collections::VecDeque;
use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use super::fault::{Fault, Meets};
use crate::tls;

/// One of the three methods of the interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// `status`, clause 5.2.
    Status,
    /// `enc_keys`, clause 5.3.
    EncKeys,
    /// `dec_keys`, clause 5.4.
    DecKeys,
}

impl Method {
    const NAMES: [(&str, Self); 3] =
        [("status", Self::Status), ("enc_keys", Self::EncKeys), ("dec_keys", Self::DecKeys)];

    pub(super) fn named(name: &str) -> Option<Self> {
        Self::NAMES.iter().find(|(known, _)| *known == name).map(|(_, method)| *method)
    }

    pub(super) fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(_, method)| *method == self).map_or("", |(name, _)| name)
    }
}

/// A [`Fault`] with the conditions for it. By default it always happens, until it is cleared.
///
/// Its text is the fault, then any of `times=N`, `probability=P` and `on=METHOD`, separated by
/// commas: `cut,times=2,on=dec_keys`.
///
/// ```
/// use etsi_qkd014::sim::{Fault, FaultPlan, Method};
/// let plan: FaultPlan = "cut,times=2,on=dec_keys".parse()?;
/// assert_eq!(plan, FaultPlan::new(Fault::CutAnswer).times(2).on(Method::DecKeys));
/// # Ok::<(), String>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct FaultPlan {
    fault: Fault,
    times: Option<u32>,
    probability: f64,
    on: Option<Method>,
}

impl FaultPlan {
    /// Creates a plan for a fault that happens until it is cleared.
    #[must_use]
    pub fn new(fault: Fault) -> Self {
        Self { fault, times: None, probability: 1.0, on: None }
    }

    /// Limits the number of times.
    #[must_use]
    pub fn times(mut self, times: u32) -> Self {
        self.times = Some(times);
        self
    }

    /// Sets the probability for each time, 0 to 1. A value outside becomes the nearer limit, and
    /// NaN becomes 0.
    #[must_use]
    pub fn probability(mut self, probability: f64) -> Self {
        self.probability = if probability.is_nan() { 0.0 } else { probability.clamp(0.0, 1.0) };
        self
    }

    /// Limits the fault to requests of this method. A fault of connections ignores it, because it
    /// happens before the method is known.
    #[must_use]
    pub fn on(mut self, method: Method) -> Self {
        self.on = Some(method);
        self
    }

    /// Returns the fault.
    #[must_use]
    pub fn fault(&self) -> &Fault {
        &self.fault
    }
}

impl fmt::Display for FaultPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.fault)?;
        if let Some(times) = self.times {
            write!(f, ",times={times}")?;
        }
        if self.probability < 1.0 {
            write!(f, ",probability={}", self.probability)?;
        }
        self.on.map_or(Ok(()), |method| write!(f, ",on={}", method.name()))
    }
}

impl FromStr for FaultPlan {
    type Err = String;

    /// Parses a plan. The error contains the text and the accepted values.
    fn from_str(text: &str) -> Result<Self, String> {
        let mut parts = text.split(',');
        let mut plan = Self::new(parts.next().unwrap_or_default().parse()?);
        let mut seen = Vec::new();
        for part in parts {
            let (name, value) = part.split_once('=').unwrap_or((part, ""));
            let wrong = |accepted: &str| format!("{text:?}: {name} is {accepted}, not {value:?}");
            match name {
                "times" => {
                    let times = value.parse().ok().filter(|times| *times > 0);
                    plan.times = Some(times.ok_or_else(|| wrong("a whole number from 1"))?);
                }
                "probability" => {
                    let chance = value.parse().ok().filter(|p| (0.0..=1.0).contains(p));
                    plan.probability = chance.ok_or_else(|| wrong("a number from 0 to 1"))?;
                }
                "on" => {
                    let method = Method::named(value);
                    plan.on = Some(method.ok_or_else(|| wrong("status, enc_keys or dec_keys"))?);
                }
                _ => {
                    return Err(format!(
                        "{text:?}: after the fault come times=N, probability=P and on=METHOD"
                    ));
                }
            }
            if seen.contains(&name) {
                return Err(format!("{text:?}: {name} is there twice"));
            }
            seen.push(name);
        }
        if plan.on.is_some() && plan.fault.meets() == Meets::Connection {
            return Err(format!("{text:?}: {} meets connections, not methods", plan.fault));
        }
        Ok(plan)
    }
}

/// The faults that affect a request.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Met {
    pub(super) delay: Duration,
    pub(super) fault: Option<Fault>,
}

/// The plans that wait at a KME. The first that matches is applied.
#[derive(Debug, Default)]
pub(super) struct Faults(VecDeque<FaultPlan>);

impl Faults {
    pub(super) fn push(&mut self, plan: FaultPlan) {
        if plan.times != Some(0) {
            self.0.push_back(plan);
        }
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &FaultPlan> {
        self.0.iter()
    }

    /// Returns the fault for a new connection.
    pub(super) fn for_connection(&mut self) -> Option<Fault> {
        self.take(|plan| plan.fault.meets() == Meets::Connection)
    }

    /// Returns the faults for a request of `method`; `None` if the request names no method.
    pub(super) fn for_request(&mut self, method: Option<Method>) -> Met {
        let fits = |plan: &FaultPlan| {
            plan.fault.meets() == Meets::Request && (plan.on.is_none() || plan.on == method)
        };
        let is_delay = |plan: &FaultPlan| matches!(plan.fault, Fault::Latency(_));
        let delay = match self.take(|plan| fits(plan) && is_delay(plan)) {
            Some(Fault::Latency(time)) => time,
            _ => Duration::ZERO,
        };
        Met { delay, fault: self.take(|plan| fits(plan) && !is_delay(plan)) }
    }

    fn take(&mut self, fits: impl Fn(&FaultPlan) -> bool) -> Option<Fault> {
        let hit = |plan: &&mut FaultPlan| fits(plan) && happens(plan.probability);
        let plan = self.0.iter_mut().find(hit)?;
        let fault = plan.fault.clone();
        if let Some(times) = &mut plan.times {
            *times -= 1;
            self.0.retain(|plan| plan.times != Some(0));
        }
        Some(fault)
    }
}

fn happens(probability: f64) -> bool {
    let mut bytes = [0; 4];
    // Without randomness every fault happens; keys could not be made either.
    let _ = tls::provider().secure_random.fill(&mut bytes);
    f64::from(u32::from_le_bytes(bytes)) < probability * (f64::from(u32::MAX) + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn plans_that_contradict_themselves_are_refused() {
        for wrong in [
            "",
            "cut,",
            "cut,times=0",
            "cut,times=-1",
            "cut,probability=2",
            "cut,probability=nan",
            "cut,on=delete",
            "cut,times=1,times=2",
            "cut,forever",
            "handshake-refused,on=status",
        ] {
            assert!(wrong.parse::<FaultPlan>().is_err(), "{wrong}");
        }
        for right in ["cut", "latency=5,probability=0.25,on=enc_keys", "handshake-refused,times=3"]
        {
            assert_eq!(right.parse::<FaultPlan>().unwrap().to_string(), right);
        }
    }

    #[test]
    fn a_fault_plan_applies_to_its_method_as_often_as_configured() {
        let mut faults = Faults::default();
        for text in ["cut,times=2,on=dec_keys", "handshake-refused,times=1", "garbage"] {
            faults.push(text.parse().unwrap());
        }
        let request = |faults: &mut Faults, method| faults.for_request(Some(method)).fault;
        assert_eq!(request(&mut faults, Method::Status), Some(Fault::Garbage));
        assert_eq!(request(&mut faults, Method::DecKeys), Some(Fault::CutAnswer));
        assert_eq!(faults.for_connection(), Some(Fault::HandshakeRefused));
        assert_eq!(faults.for_connection(), None);
        assert_eq!(request(&mut faults, Method::DecKeys), Some(Fault::CutAnswer));
        assert_eq!(request(&mut faults, Method::DecKeys), Some(Fault::Garbage));
        faults.clear();
        assert_eq!(request(&mut faults, Method::DecKeys), None);
    }

    #[test]
    fn latency_adds_to_the_fault_behind_it() {
        let mut faults = Faults::default();
        faults.push("latency=3".parse().unwrap());
        faults.push("cut,times=1".parse().unwrap());
        let delay = Duration::from_millis(3);
        let first = faults.for_request(Some(Method::EncKeys));
        assert_eq!(first, Met { delay, fault: Some(Fault::CutAnswer) });
        assert_eq!(faults.for_request(None), Met { delay, fault: None });
    }

    #[test]
    fn faults_occur_at_about_the_configured_probability() {
        let mut faults = Faults::default();
        faults.push(FaultPlan::new(Fault::CutAnswer).probability(0.5));
        let hits = (0..4000).filter(|_| faults.for_request(None).fault.is_some()).count();
        // Within ten standard deviations.
        assert!((1684..=2316).contains(&hits), "{hits}");
        faults.clear();
        faults.push(FaultPlan::new(Fault::CutAnswer).probability(f64::NAN));
        assert!((0..1000).all(|_| faults.for_request(None).fault.is_none()));
    }

    proptest! {
        #[test]
        fn any_text_is_parsed_without_panic(text: String) {
            let _ = text.parse::<FaultPlan>();
        }
    }
}
