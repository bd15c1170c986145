//! When a process that died is started again: at once the first time, then after twice as long each time, and not for
//! ever.

use std::time::Duration;

/// A process that dies so often in a row is given up, and the run with it.
pub const DEATHS_MAX: u32 = 10;

/// One that has lived for so long begins a new row.
pub const HEALTHY_AFTER: Duration = Duration::from_secs(60);

/// From the second death in a row to the start that follows.
const FIRST_DELAY: Duration = Duration::from_millis(250);

/// The longest delay. All of a row together last for three quarters of a minute: what passes in that time, such as
/// memory that is full, ends no run.
const LONGEST_DELAY: Duration = Duration::from_secs(15);

/// The deaths of one process.
#[derive(Clone, Copy, Debug, Default)]
pub struct Restarts {
    started: Duration,
    deaths: u32,
}

impl Restarts {
    /// It was started at this moment.
    pub fn started(&mut self, now: Duration) {
        self.started = now;
    }

    /// It died at this moment: how long to wait before it is started again, or `None` when it is given up.
    pub fn died(&mut self, now: Duration) -> Option<Duration> {
        if now.saturating_sub(self.started) >= HEALTHY_AFTER {
            self.deaths = 0;
        }
        self.deaths += 1;
        match self.deaths {
            1 => Some(Duration::ZERO),
            DEATHS_MAX.. => None,
            deaths => Some((FIRST_DELAY * (1 << (deaths - 2))).min(LONGEST_DELAY)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_grow_until_a_process_is_given_up() {
        let mut restarts = Restarts::default();
        let mut now = Duration::from_secs(100);
        let mut delays = vec![];
        while let Some(delay) = restarts.died(now) {
            delays.push(delay.as_millis());
            now += delay;
            restarts.started(now);
        }
        assert_eq!(delays, [0, 250, 500, 1000, 2000, 4000, 8000, 15_000, 15_000]);
    }

    #[test]
    fn a_process_that_has_lived_begins_anew() {
        let mut restarts = Restarts::default();
        restarts.started(Duration::ZERO);
        for _ in 0..3 {
            restarts.died(Duration::from_secs(1));
        }
        restarts.started(Duration::from_secs(2));
        assert_eq!(restarts.died(Duration::from_secs(61)), Some(Duration::from_secs(1)), "59 s are too few");
        restarts.started(Duration::from_secs(62));
        assert_eq!(restarts.died(Duration::from_secs(122)), Some(Duration::ZERO));
    }
}
