//! A world that a seed makes: processes, links, a disk, a clock that jumps from one event to the next.

use super::{
    Tally,
    actor::{Down, Rolling, Up},
    faults::{Fault, Plan},
    learner::{Learner, Saved, episode},
};
use crate::supervisor::{Effect, Event, Exit, Hung, Outcome, Place, Standing, Supervisor};
use rand::RngExt as _;
use rit_config::Config;
use rit_episode::{Rng, RunSeed, Stream};
use rit_learner::{
    coordinator::{Input, Joining},
    ledger::ActorId,
    receive::Fence,
    summary::Ended,
};
use rit_proto::v1::RunState;
use std::{
    cmp::Ordering,
    collections::{BTreeMap, BTreeSet, BinaryHeap, VecDeque},
    ops::Range,
    sync::Arc,
    time::Duration,
};

/// Once nothing more is done to it, a run comes to its end within so long.
const PEACE_MAX: Duration = Duration::from_secs(400);

/// The supervisor looks at the run this often.
const POLL_EVERY: Duration = Duration::from_secs(1);

/// A question that gets no answer is given up after so long.
const ASK_TIMEOUT: Duration = Duration::from_secs(4);

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
    /// A process hears that it is to end in order.
    Asked(usize),
    /// Somebody asks something of the learner.
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
    /// Whoever resumes the run tries to.
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
    supervisor: u32,
    pub dead: bool,
    /// By SIGSTOP, with what it will find when it goes on.
    stopped: Option<Vec<What>>,
    /// Told to end in order.
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
    /// Milliseconds that an episode takes at most.
    pub roll_ms: u64,
    /// Something happened that ends a run in failure, rightly.
    pub may_fail: bool,
    /// A learner has answered this supervisor.
    pub begun: bool,
    /// Somebody has ended the run before its time.
    may_end_early: bool,
    latency_ms: u64,
    rng: Rng,
    queue: BinaryHeap<Scheduled>,
    order: u64,
    /// The supervisor that there is, and how many there were before.
    supervisor: Option<M::Supervisor>,
    supervisors: u32,
    contacted: bool,
    children: BTreeMap<Place, usize>,
    peace_since: Option<Duration>,
    outcome: Option<Outcome>,
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

    fn notes(&mut self, what: impl FnOnce() -> String) {
        let now = self.now;
        if let Some(course) = &mut self.course {
            course.push(format!("{:>10.3} {}", now.as_secs_f64(), what()));
        }
    }

    // The supervisor and its children.

    fn begin_supervisor(&mut self) {
        self.supervisors += 1;
        self.supervisor = Some(M::Supervisor::new(self.config.actors.count as u32));
        (self.contacted, self.begun) = (false, false);
        self.tell_supervisor(Event::Begin);
        self.after(POLL_EVERY, What::Poll(self.supervisors));
    }

    fn tell_supervisor(&mut self, event: Event) {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            let now = self.now;
            let Some(supervisor) = &mut self.supervisor else { return };
            for effect in supervisor.handle(event, now) {
                self.notes(|| format!("  {effect:?}"));
                events.extend(self.supervisor_does(effect));
            }
        }
    }

    fn supervisor_does(&mut self, effect: Effect) -> Option<Event> {
        match effect {
            Effect::Start(place) => return Some(self.starts(place)),
            Effect::AskToEnd(place) => {
                if let Some(&process) = self.children.get(&place) {
                    let delay = self.latency();
                    self.after(delay, What::Asked(process));
                }
            }
            Effect::Kill(place) => {
                if let Some(&process) = self.children.get(&place) {
                    self.dies(process, Exit::Signal(9));
                }
            }
            Effect::StopRun => {
                let delay = self.latency();
                self.after(delay, What::Control(Control::Stop { drain: false }));
            }
            Effect::RemoveSharedMemory => {
                if !self.children.is_empty() {
                    self.breaks(format!("shared memory of {:?} is removed", self.children.keys()));
                }
            }
            Effect::Say(_) => {}
            Effect::Over(outcome) => {
                if !self.children.is_empty() {
                    self.breaks(format!("the run is over, and there are {:?}", self.children.keys()));
                }
                self.outcome = Some(outcome);
            }
        }
        None
    }

    fn starts(&mut self, place: Place) -> Event {
        let number = self.processes.len();
        let actor = Actor { gone_since: self.now, ..Actor::default() };
        let supervisor = self.supervisors;
        let process =
            Process { number, place, supervisor, dead: false, stopped: None, leaving: false, actor };
        let pid = process.pid();
        self.processes.push(process);
        if let Some(before) = self.children.insert(place, number) {
            self.breaks(format!("{place} is process {before} and is started as process {number} too"));
        }
        if place == Place::Learner {
            self.contacted = false;
        }
        let time = self.millis(5..300);
        self.after(time, What::Begins(number));
        Event::Started(place, pid)
    }

    fn begins(&mut self, process: usize) {
        match self.processes[process].place {
            Place::Learner => self.learner_begins(process),
            // Memory that cannot be had is a signal to whoever writes to it.
            Place::Actor(_) if self.now < self.memory_full_until => self.dies(process, Exit::Signal(7)),
            Place::Actor(_) => self.connects(process),
        }
    }

    /// A process ends, whatever of.
    pub fn dies(&mut self, process: usize, exit: Exit) {
        if std::mem::replace(&mut self.processes[process].dead, true) {
            return;
        }
        self.tally.deaths += 1;
        let Process { place, supervisor, .. } = self.processes[process];
        self.notes(|| format!("  {place}, process {process}, {exit}"));
        if place == Place::Learner {
            self.learner = None;
            for link in 0..self.links.len() {
                let Link { process: actor, learner, .. } = self.links[link];
                if learner == process && !self.processes[actor].dead {
                    self.down(link, Down::End);
                }
            }
        } else if let Some(link) = self.processes[process].actor.link {
            // Now and then the learner notices only after the successor has come.
            if self.rng.random_range(0..4) == 0 {
                self.links[link].next_up = self.now + self.millis(0..3000);
            }
            self.up(link, Up::End);
        }
        let delay = self.latency();
        self.after(delay, What::Reaped(supervisor, place, exit));
    }

    fn reaped(&mut self, supervisor: u32, place: Place, exit: Exit) {
        if supervisor == self.supervisors && self.supervisor.is_some() {
            self.children.remove(&place);
            self.tell_supervisor(Event::Ended { place, exit, last_words: "its last words".into() });
        }
    }

    fn is_asked(&mut self, process: usize) {
        match self.processes[process].place {
            Place::Actor(_) => self.leaves(process),
            Place::Learner if self.learner.is_some() => {
                self.learner_is_asked(Input::Stop { drain: false, ended: Ended::Interrupted });
            }
            // It hears of it once it has begun.
            Place::Learner => {
                let wait = self.millis(50..100);
                self.after(wait, What::Asked(process));
            }
        }
    }

    /// The supervisor asks the learner how the run stands.
    fn polls(&mut self, supervisor: u32) {
        if supervisor != self.supervisors || self.supervisor.is_none() {
            return;
        }
        let answers =
            self.learner.as_ref().is_some_and(|learner| self.processes[learner.life].stopped.is_none());
        let event = match (answers, self.contacted) {
            (true, false) => {
                (self.contacted, self.begun) = (true, true);
                Some(Event::Answers)
            }
            (true, true) => self.status(),
            (false, _) => {
                self.children.contains_key(&Place::Learner).then(|| Event::NoAnswer("silent".into()))
            }
        };
        if let Some(event) = event {
            self.tell_supervisor(event);
        }
        self.after(if answers { POLL_EVERY } else { ASK_TIMEOUT }, What::Poll(supervisor));
    }

    fn status(&mut self) -> Option<Event> {
        let now = self.now;
        let learner = self.learner.as_ref()?;
        let status = learner.status(now);
        let stands = now.saturating_sub(learner.moved);
        let says = learner.coordinator.stands_still().is_some();
        let hung = status.actors.iter().filter(|actor| actor.hung);
        let standing = Standing {
            actors_wanted: status.actors_wanted,
            hung: hung.map(|actor| Hung { pid: actor.pid, silent_s: actor.silent_s as u64 }).collect(),
            ending: status.state() == RunState::Stopping,
        };
        let names: BTreeSet<&str> = status.actors.iter().map(|actor| actor.name.as_str()).collect();
        if names.len() != status.actors.len() {
            self.breaks(format!("the learner counts a slot twice: {:?}", status.actors));
        } else if status.state() == RunState::Running
            && stands > Duration::from_millis(self.config.learner.stall_timeout_ms) + Duration::from_secs(60)
            && !says
        {
            self.breaks(format!("the run stands still for {} s and does not say why", stands.as_secs()));
        }
        Some(Event::Status(standing))
    }

    // What is done to the run.

    /// A child that lives, and whether it is the learner.
    fn victim(&self, which: usize) -> Option<usize> {
        let living: Vec<usize> =
            self.children.values().copied().filter(|&process| !self.processes[process].dead).collect();
        (!living.is_empty()).then(|| living[which % living.len()])
    }

    fn suffers(&mut self, fault: Fault) {
        match fault {
            Fault::Signal { which, signal } => {
                let Some(victim) = self.victim(which) else { return };
                if matches!(signal, 2 | 15) {
                    self.may_end_early |= self.processes[victim].place == Place::Learner;
                    self.after(Duration::ZERO, What::Asked(victim));
                } else {
                    self.dies(victim, Exit::Signal(signal));
                }
            }
            Fault::Stop { which, ms } => {
                let Some(victim) = self.victim(which) else { return };
                self.processes[victim].stopped.get_or_insert_default();
                self.after(Duration::from_millis(ms), What::GoesOn(victim));
            }
            Fault::Count(count) => self.set_config(|config| config.actors.count = count as usize),
            Fault::Pause { ms } => {
                self.learner_is_asked(Input::Pause);
                self.after(Duration::from_millis(ms), What::Control(Control::Resume));
            }
            Fault::DiskFull { ms } => self.disk_full_until = self.now + Duration::from_millis(ms),
            Fault::MemoryFull { ms } => self.memory_full_until = self.now + Duration::from_millis(ms),
            Fault::Damage { frames } => self.damaged_frames += frames,
            Fault::BreakLink { which } => self.breaks_link(which),
            Fault::Slow { ms } => self.latency_ms = ms + 1,
            Fault::PowerLoss => self.loses_power(),
            Fault::KillSupervisor => self.loses_supervisor(),
            Fault::Interrupt => {
                self.may_end_early = true;
                // One that does not answer is ended otherwise than in order.
                self.may_fail = true;
                self.tell_supervisor(Event::Interrupted);
            }
            Fault::StopRun { drain } => {
                self.may_end_early |= self.learner.is_some();
                self.after(Duration::ZERO, What::Control(Control::Stop { drain }));
            }
        }
    }

    fn breaks_link(&mut self, which: usize) {
        let Some(victim) = self.victim(which) else { return };
        if let Some(link) = self.processes[victim].actor.link {
            self.up(link, Up::End);
            self.down(link, Down::End);
        }
    }

    fn loses_power(&mut self) {
        if self.supervisor.take().is_none() {
            return;
        }
        for process in std::mem::take(&mut self.children).into_values() {
            self.dies(process, Exit::Signal(9));
        }
        let wait = self.millis(500..2000);
        self.after(wait, What::Resumed);
    }

    /// Its children find that their lifelines are closed; one that is stopped finds it later.
    fn loses_supervisor(&mut self) {
        if self.supervisor.take().is_none() {
            return;
        }
        for process in std::mem::take(&mut self.children).into_values() {
            if self.processes[process].place == Place::Learner {
                self.goes_on(process);
            }
            let delay = self.latency();
            self.after(delay, What::Asked(process));
        }
        self.after(Duration::from_millis(500), What::Resumed);
    }

    /// `rit train --resume`, which is refused while a learner lives.
    fn is_resumed(&mut self) {
        let learner_lives =
            self.processes.iter().any(|process| process.place == Place::Learner && !process.dead);
        if learner_lives {
            self.after(Duration::from_millis(500), What::Resumed);
        } else {
            self.begin_supervisor();
        }
    }

    fn goes_on(&mut self, process: usize) {
        for what in self.processes[process].stopped.take().into_iter().flatten() {
            self.at(self.now, what);
        }
    }

    fn peace(&mut self) {
        self.peace_since = Some(self.now);
        (self.disk_full_until, self.memory_full_until, self.damaged_frames) = (self.now, self.now, 0);
        for process in 0..self.processes.len() {
            self.goes_on(process);
        }
        self.after(Duration::ZERO, What::Control(Control::Resume));
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
