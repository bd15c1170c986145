//! A world that a seed makes: processes, links, a disk, a clock that jumps from one event to the next.

use super::{
    Tally,
    actor::{Down, Rolling, Up},
    faults::{Fault, Plan},
    learner::{Learner, Saved, episode},
};
use crate::supervisor::{Effect, Event, Exit, Outcome, Place, Supervisor};
use rand::RngExt as _;
use rit_config::Config;
use rit_episode::{Rng, RunSeed, Stream};
use rit_learner::{
    coordinator::{Input, Joining},
    ledger::ActorId,
    receive::Fence,
};
use rit_record::Ended;
use std::{
    cmp::Ordering,
    collections::{BTreeMap, BinaryHeap, VecDeque},
    ops::Range,
    sync::Arc,
    time::Duration,
};

/// Once nothing more is done to it, a run comes to its end within so long.
const PEACE_MAX: Duration = Duration::from_secs(400);

/// The supervisor looks at the run this often.
pub const POLL_EVERY: Duration = Duration::from_secs(1);

/// A question that gets no answer is given up after so long.
pub const ASK_TIMEOUT: Duration = Duration::from_secs(4);

/// No scenario takes so many events.
const EVENTS_MAX: u64 = 200_000;

/// Who decides: the product's machines, or in tests others with a fault in them.
pub trait Machines {
    /// The supervisor.
    type Supervisor: Supervises;

    /// What an actor says of itself when it joins.
    fn joining(joining: Joining) -> Joining {
        joining
    }
}

/// What a world needs of a supervisor.
pub trait Supervises {
    fn new(actors: u32) -> Self;
    fn handle(&mut self, event: Event, now: Duration) -> Vec<Effect>;
    fn deadline(&self) -> Option<Duration>;
}

impl Supervises for Supervisor {
    fn new(actors: u32) -> Self {
        Self::new(actors, String::new())
    }

    fn handle(&mut self, event: Event, now: Duration) -> Vec<Effect> {
        Self::handle(self, event, now)
    }

    fn deadline(&self) -> Option<Duration> {
        Self::deadline(self)
    }
}

/// The product's machines.
pub struct Real;

impl Machines for Real {
    type Supervisor = Supervisor;
}

/// What happens at some moment.
#[derive(Clone, Debug)]
pub enum What {
    /// The supervisor of this number looks at the run.
    Poll(u32),
    /// A process has started up.
    Begins(usize),
    /// A process ends by itself.
    Dies(usize, Exit),
    /// The supervisor of this number finds that a child has ended.
    Reaped(u32, Place, Exit),
    /// A process hears that it is to shut down gracefully.
    Asked(usize),
    /// A control call asks something of the learner.
    Control(Control),
    Look(usize),
    Trained(usize),
    Written(usize, Box<Saved>),
    Finished(usize),
    Fenced(usize, Fence),
    Frame {
        learner: usize,
        actor: ActorId,
        number: u64,
        version: u64,
        damaged: bool,
    },
    Connects(usize),
    Up(usize, Up),
    Down(usize, Down),
    Beats(usize),
    Rolled(usize),
    Fault(Fault),
    /// A process that was stopped goes on.
    GoesOn(usize),
    /// The run is resumed, or its resume is tried.
    Resumed,
    /// Nothing more is done to the run.
    Peace,
}

/// What people ask of a learner.
#[derive(Clone, Debug)]
pub enum Control {
    Resume,
    Stop { drain: bool },
}

struct Scheduled {
    at: Duration,
    order: u64,
    what: What,
}

impl PartialEq for Scheduled {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Scheduled {}

impl PartialOrd for Scheduled {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Scheduled {
    /// The greatest is the next.
    fn cmp(&self, other: &Self) -> Ordering {
        (other.at, other.order).cmp(&(self.at, self.order))
    }
}

/// A process.
#[derive(Debug)]
pub struct Process {
    pub number: usize,
    pub place: Place,
    /// Whose child it is.
    pub(super) supervisor: u32,
    pub dead: bool,
    /// By SIGSTOP, with what it will find when it goes on.
    pub(super) stopped: Option<Vec<What>>,
    /// Told to shut down gracefully.
    pub leaving: bool,
    pub actor: Actor,
}

/// What an actor has.
#[derive(Debug, Default)]
pub struct Actor {
    pub link: Option<usize>,
    /// Since when it has no learner; the end of time while it has one.
    pub gone_since: Duration,
    pub leases: VecDeque<Rolling>,
}

impl Process {
    pub fn slot(&self) -> Option<u32> {
        match self.place {
            Place::Learner => None,
            Place::Actor(slot) => Some(slot),
        }
    }
}

/// A stream between an actor and a learner.
#[derive(Debug, Default)]
pub struct Link {
    /// The actor's process.
    pub process: usize,
    /// The learner's.
    pub learner: usize,
    /// Who the actor is to the learner.
    pub actor: Option<ActorId>,
    pub joined: bool,
    pub next_up: Duration,
    pub next_down: Duration,
    pub next_frame: Duration,
}

/// The world.
pub struct World<M: Machines> {
    pub plan: Plan,
    pub config: Arc<Config>,
    pub now: Duration,
    pub tally: Tally,
    pub processes: Vec<Process>,
    pub links: Vec<Link>,
    pub learner: Option<Learner>,
    /// The newest checkpoint on disk.
    pub saved: Saved,
    /// By batch, the weights it was rolled with.
    pub versions: Vec<u64>,
    pub disk_full_until: Duration,
    pub memory_full_until: Duration,
    pub damaged_frames: u32,
    pub lost_episodes: u32,
    /// Milliseconds that an episode takes at most.
    pub roll_ms: u64,
    /// Something happened that ends a run in failure, rightly.
    pub may_fail: bool,
    /// A learner has answered this supervisor.
    pub begun: bool,
    /// A fault has ended the run before its time.
    pub(super) may_end_early: bool,
    pub(super) latency_ms: u64,
    pub(super) rng: Rng,
    queue: BinaryHeap<Scheduled>,
    order: u64,
    /// The supervisor that there is, and how many there were before.
    pub(super) supervisor: Option<M::Supervisor>,
    pub(super) supervisors: u32,
    pub(super) contacted: bool,
    pub(super) children: BTreeMap<Place, usize>,
    pub(super) peace_since: Option<Duration>,
    pub(super) outcome: Option<Outcome>,
    broken: Option<String>,
    course: Option<Vec<String>>,
}

impl<M: Machines> World<M> {
    pub fn new(config: &Config, seed: u64) -> Self {
        let mut rng = RunSeed(seed).derive("simulated soak", 0).stream(Stream::Exploration, 0);
        let plan = Plan::draw(&mut rng);
        let mut config = config.clone();
        config.algorithm.n_rollout_threads = plan.episodes_per_batch;
        config.algorithm.policy_lag = plan.policy_lag;
        config.actors.count = plan.actors as usize;
        config.actors.heartbeat_timeout_ms = plan.heartbeat_timeout_ms;
        config.actors.episodes_at_once = rng.random_range(1..4);
        Self {
            saved: Saved::fresh(plan.policy_lag),
            roll_ms: rng.random_range(20..1500),
            latency_ms: rng.random_range(1..30),
            plan,
            config: Arc::new(config),
            now: Duration::ZERO,
            tally: Tally::default(),
            processes: Vec::new(),
            links: Vec::new(),
            learner: None,
            versions: Vec::new(),
            disk_full_until: Duration::ZERO,
            memory_full_until: Duration::ZERO,
            damaged_frames: 0,
            lost_episodes: 0,
            may_fail: false,
            begun: false,
            may_end_early: false,
            rng,
            queue: BinaryHeap::new(),
            order: 0,
            supervisor: None,
            supervisors: 0,
            contacted: false,
            children: BTreeMap::new(),
            peace_since: None,
            outcome: None,
            broken: None,
            course: None,
        }
    }

    /// Writes down what happens from now on.
    pub fn keep_course(&mut self) {
        self.course = Some(Vec::new());
    }

    /// Runs to the end. Returns what it came to, and the promise that was broken, if one was.
    pub fn run(mut self) -> (Tally, Option<String>) {
        self.run_to_the_end();
        (self.tally, self.broken)
    }

    /// Likewise; returns the course.
    pub fn run_and_tell(mut self) -> Vec<String> {
        self.run_to_the_end();
        self.course.unwrap_or_default()
    }

    fn run_to_the_end(&mut self) {
        let faults = self.plan.faults.clone();
        let last = faults.last().map_or(Duration::ZERO, |(at, _)| *at);
        for (at, fault) in faults {
            self.at(at, What::Fault(fault));
        }
        // What was done for a while has an end as well.
        self.at(last + Duration::from_secs(1), What::Peace);
        self.begin_supervisor();
        while self.outcome.is_none() && self.broken.is_none() {
            self.step();
        }
        self.check_end();
    }

    fn step(&mut self) {
        self.tally.events += 1;
        if self.tally.events > EVENTS_MAX {
            return self.breaks("it does not come to rest".into());
        }
        let next = self.queue.peek().map(|next| next.at);
        let tick = self.supervisor.as_ref().and_then(Supervises::deadline);
        if let Some(tick) = tick.filter(|tick| next.is_none_or(|next| *tick <= next)) {
            self.now = self.now.max(tick);
            self.tell_supervisor(Event::Tick);
        } else if let Some(Scheduled { at, what, .. }) = self.queue.pop() {
            self.now = at;
            if let Some(what) = self.defer_if_stopped(what) {
                self.notes(|| format!("{what:?}"));
                self.happens(what);
            }
        } else {
            self.breaks("nothing more happens, and the run is not over".into());
        }
        if self.peace_since.is_some_and(|since| self.now > since + PEACE_MAX) {
            let still = self.learner.as_ref().and_then(|learner| learner.coordinator.stands_still());
            self.breaks(format!("the run is left in peace and does not end: {still:?}"));
        }
    }

    /// What a process would notice waits while it is stopped, and is lost when it is dead.
    fn defer_if_stopped(&mut self, what: What) -> Option<What> {
        let learner = self.learner.as_ref().map(|learner| learner.life);
        let process = match &what {
            What::Begins(process)
            | What::Connects(process)
            | What::Dies(process, _)
            | What::Asked(process) => Some(*process),
            What::Look(life)
            | What::Trained(life)
            | What::Written(life, _)
            | What::Finished(life)
            | What::Fenced(life, _)
            | What::Frame { learner: life, .. } => Some(*life),
            What::Control(_) => learner,
            What::Up(link, _) => Some(self.links[*link].learner),
            What::Down(link, _) | What::Beats(link) | What::Rolled(link) => Some(self.links[*link].process),
            What::Poll(_)
            | What::Reaped(..)
            | What::Fault(_)
            | What::GoesOn(_)
            | What::Resumed
            | What::Peace => None,
        };
        let Some(process) = process.map(|process| &mut self.processes[process]) else { return Some(what) };
        if process.dead {
            return None;
        }
        match &mut process.stopped {
            Some(deferred) => {
                deferred.push(what);
                None
            }
            None => Some(what),
        }
    }

    fn happens(&mut self, what: What) {
        match what {
            What::Poll(supervisor) => self.polls(supervisor),
            What::Begins(process) => self.begins(process),
            What::Dies(process, exit) => self.dies(process, exit),
            What::Reaped(supervisor, place, exit) => self.reaped(supervisor, place, exit),
            What::Asked(process) => self.is_asked(process),
            What::Control(Control::Resume) => self.learner_is_asked(Input::Resume),
            What::Control(Control::Stop { drain }) => {
                self.learner_is_asked(Input::Stop { drain, ended: Ended::Stopped });
            }
            What::Look(life) => self.look(life),
            What::Trained(life) => self.trained(life),
            What::Written(_, state) => self.written(&state),
            What::Finished(_) => self.finished(),
            What::Fenced(_, fence) => self.fenced(fence),
            What::Frame { damaged: true, .. } => self.tell(Input::FrameRefused("checksum")),
            What::Frame { actor, number, version, .. } => {
                self.tell(Input::Episode(actor, episode(number, version)));
            }
            What::Connects(process) => {
                if self.processes[process].actor.link.is_none() {
                    self.connects(process);
                }
            }
            What::Up(link, message) => self.arrives_up(link, &message),
            What::Down(link, message) => self.arrives_down(link, message),
            What::Beats(link) => self.beats(link),
            What::Rolled(link) => self.rolled(link),
            What::Fault(fault) => self.suffers(fault),
            What::GoesOn(process) => self.goes_on(process),
            What::Resumed => self.is_resumed(),
            What::Peace => self.peace(),
        }
    }

    // Time and chance.

    pub fn at(&mut self, at: Duration, what: What) {
        self.order += 1;
        self.queue.push(Scheduled { at, order: self.order, what });
    }

    pub fn after(&mut self, delay: Duration, what: What) {
        self.at(self.now + delay, what);
    }

    pub fn millis(&mut self, range: Range<u64>) -> Duration {
        Duration::from_micros(self.rng.random_range(range.start * 1000..range.end * 1000))
    }

    pub fn latency(&mut self) -> Duration {
        self.millis(0..self.latency_ms)
    }

    /// A promise is broken: the scenario ends here.
    pub fn breaks(&mut self, what: String) {
        self.notes(|| format!("BROKEN: {what}"));
        self.broken.get_or_insert(what);
    }

    pub(super) fn notes(&mut self, what: impl FnOnce() -> String) {
        let now = self.now;
        if let Some(course) = &mut self.course {
            course.push(format!("{:>10.3} {}", now.as_secs_f64(), what()));
        }
    }

    /// Whether the run came to the end that it should have.
    fn check_end(&mut self) {
        let whole = self.saved.batches == self.plan.batches;
        let broken = match &self.outcome {
            None => return,
            Some(Outcome::Finished) if whole || self.may_end_early => return,
            Some(Outcome::Interrupted) if self.may_end_early => return,
            Some(Outcome::Failed { .. }) if self.may_fail => return,
            Some(outcome) => format!("it ends with {outcome:?}, {} batches done", self.saved.batches),
        };
        self.breaks(broken);
    }
}
