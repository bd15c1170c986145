//! Prints each warning of the learner once.

use rit_proto::v1::RunStatus;
use std::collections::BTreeSet;

/// Which warnings are known already.
#[derive(Debug, Default)]
pub struct Warnings {
    /// The learner's process: another one counts its time anew.
    learner: u32,
    /// Seconds since it began.
    known_until_s: f64,
    /// All that were said.
    said: BTreeSet<String>,
}

impl Warnings {
    /// The warnings of a status that were not there before, oldest first.
    pub fn new_of(&mut self, status: &RunStatus) -> Vec<String> {
        if status.pid != self.learner {
            (self.learner, self.known_until_s) = (status.pid, f64::NEG_INFINITY);
        }
        let known = self.known_until_s;
        let new = status.happenings.iter().filter(|happening| happening.wall_s > known);
        self.known_until_s = new.clone().map(|happening| happening.wall_s).fold(known, f64::max);
        let new: Vec<_> =
            new.filter(|happening| happening.warning).map(|happening| happening.what.clone()).collect();
        self.said.extend(new.iter().cloned());
        new
    }

    /// Those of a run that is over that were never said: its learner may have ended before it was asked how it stands.
    pub fn left_of(&mut self, warnings: Vec<String>) -> Vec<String> {
        warnings.into_iter().filter(|what| self.said.insert(what.clone())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_proto::v1::Happening;

    #[test]
    fn each_warning_is_said_once_and_a_new_learner_says_its_own() {
        let happening =
            |wall_s, what: &str, warning| Happening { wall_s, env_steps: 0, what: what.into(), warning };
        let status = |pid, happenings| RunStatus { pid, happenings, ..RunStatus::default() };
        let (a, b, c) = (happening(0.0, "a", true), happening(1.0, "b", false), happening(2.0, "c", true));
        let mut warnings = Warnings::default();
        assert_eq!(warnings.new_of(&status(7, vec![a.clone(), b.clone()])), ["a"]);
        assert_eq!(warnings.new_of(&status(7, vec![a.clone(), b, c])), ["c"]);
        assert!(warnings.new_of(&status(7, vec![a.clone()])).is_empty());
        assert_eq!(warnings.new_of(&status(8, vec![a])), ["a"]);
        assert_eq!(warnings.left_of(vec!["a".into(), "d".into(), "d".into()]), ["d"]);
    }
}
