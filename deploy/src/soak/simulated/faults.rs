//! What a scenario does to a run: drawn from its seed, before it begins.

use rand::RngExt as _;
use rit_episode::Rng;
use std::time::Duration;

/// Faults come within so long after the beginning.
const FAULTS_WITHIN_MS: u64 = 20_000;

/// Memory is full for so long at most: what the restarts of one process outlast.
const MEMORY_FULL_MS: u64 = 6_000;

/// Signals that end a process at once.
const DEADLY: [i32; 5] = [1, 3, 7, 9, 11];

/// Something that is done to a run. `which` chooses among what is there at the time.
#[derive(Clone, Copy, Debug)]
pub enum Fault {
    /// A signal to a process.
    Signal { which: usize, signal: i32 },
    /// A process stops, and goes on after so many milliseconds, if it has not been killed.
    Stop { which: usize, ms: u64 },
    /// `rit ctl set actors.count`.
    Count(u32),
    /// `rit ctl pause`, and `resume` after so many milliseconds.
    Pause { ms: u64 },
    /// The disk is full for so many milliseconds.
    DiskFull { ms: u64 },
    /// Shared memory is full for so many milliseconds: a process that starts dies of it.
    MemoryFull { ms: u64 },
    /// So many frames arrive damaged.
    Damage { frames: u32 },
    /// Environments lose so many episodes.
    Lose { episodes: u32 },
    /// An actor's link to the learner breaks; both live.
    BreakLink { which: usize },
    /// Messages take so much longer from now on.
    Slow { ms: u64 },
    /// Everything dies at once; the run is resumed.
    PowerLoss,
    /// The supervisor alone is killed; the run is resumed once its learner has gone.
    KillSupervisor,
    /// Ctrl-C.
    Interrupt,
    /// `rit ctl stop`.
    StopRun { drain: bool },
}

/// What a scenario is.
#[derive(Clone, Debug)]
pub struct Plan {
    pub actors: u32,
    pub episodes_per_batch: usize,
    pub policy_lag: usize,
    pub batches: u64,
    pub checkpoint_every_batches: u64,
    pub heartbeat_timeout_ms: u64,
    /// From the beginning of training, in order of time.
    pub faults: Vec<(Duration, Fault)>,
}

impl Plan {
    pub fn draw(rng: &mut Rng) -> Self {
        let count = rng.random_range(0..9_usize);
        let mut faults: Vec<(Duration, Fault)> = (0..count)
            .map(|_| (Duration::from_micros(rng.random_range(0..FAULTS_WITHIN_MS * 1000)), fault(rng)))
            .collect();
        if rng.random_range(0..3) == 0 {
            counts_in_quick_succession(rng, &mut faults);
        }
        faults.sort_by_key(|(at, _)| *at);
        // Of memory that is full and deaths at once no process may die ten times: then giving up is right.
        let mut memory_was_full = false;
        faults.retain(|(_, fault)| {
            !matches!(fault, Fault::MemoryFull { .. }) || !std::mem::replace(&mut memory_was_full, true)
        });
        if memory_was_full {
            let mut deaths = 0;
            faults.retain(|(_, fault)| {
                deaths += u32::from(matches!(fault, Fault::Signal { .. } | Fault::Stop { .. }));
                !matches!(fault, Fault::Signal { .. } | Fault::Stop { .. }) || deaths <= 2
            });
        }
        Self {
            actors: rng.random_range(1..4),
            episodes_per_batch: rng.random_range(1..5),
            policy_lag: rng.random_range(0..3),
            batches: rng.random_range(3..10),
            checkpoint_every_batches: rng.random_range(1..5),
            heartbeat_timeout_ms: rng.random_range(2000..6000),
            faults,
        }
    }
}

fn counts_in_quick_succession(rng: &mut Rng, faults: &mut Vec<(Duration, Fault)>) {
    let mut at = rng.random_range(0..FAULTS_WITHIN_MS * 1000);
    for _ in 0..rng.random_range(2..7) {
        at += rng.random_range(0..300_000);
        faults.push((Duration::from_micros(at), Fault::Count(rng.random_range(1..6))));
    }
}

fn fault(rng: &mut Rng) -> Fault {
    let which = rng.random_range(0..16);
    match rng.random_range(0..100) {
        0..16 => Fault::Signal { which, signal: DEADLY[rng.random_range(0..DEADLY.len())] },
        16..32 => Fault::Signal { which, signal: if rng.random() { 15 } else { 2 } },
        32..44 => Fault::Stop { which, ms: rng.random_range(500..40_000) },
        44..54 => Fault::Count(rng.random_range(1..6)),
        54..62 => Fault::Pause { ms: rng.random_range(0..8000) },
        62..68 => Fault::DiskFull { ms: rng.random_range(0..8000) },
        68..72 => Fault::MemoryFull { ms: rng.random_range(0..MEMORY_FULL_MS) },
        72..75 => Fault::Damage { frames: rng.random_range(1..4) },
        75..78 => Fault::Lose { episodes: rng.random_range(1..4) },
        78..86 => Fault::BreakLink { which },
        86..90 => Fault::Slow { ms: rng.random_range(0..400) },
        90..94 => Fault::PowerLoss,
        94..97 => Fault::KillSupervisor,
        97..98 => Fault::Interrupt,
        _ => Fault::StopRun { drain: rng.random() },
    }
}
