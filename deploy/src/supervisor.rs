//! Which of a run's processes are started, asked to end and killed, and when: the decisions of `rit train` as a state
//! machine. It is told what happened and at what time, and answers with what is to be done; processes, clocks and
//! sockets are its shell's (`supervisor/shell.rs`). So the simulator (`soak/simulated`) drives this very code.
//!
//! An actor is its slot. Slots below the wanted count are filled, each by one process at a time, whatever died, left
//! or was started in whatever order; a slot that is wanted again while its process still leaves waits for its end.

mod interrupts;
mod lifecycle;
mod messages;
mod process;
mod restarts;
mod shell;
#[cfg(test)]
mod tests;

use crate::{
    failure::{INCOMPATIBLE, UNAVAILABLE},
    report::counted,
};
use lifecycle::{Process, State, Up};
use restarts::DEATHS_MAX;
use rit_record::Ended;
use std::{collections::BTreeMap, time::Duration};

pub use messages::{Effect, Event, Exit, Hung, Outcome, Place, Standing};
pub use shell::watch_over;

/// Exit codes of a learner that has ended a run gracefully: as a caller asked it to, or as a signal did.
const STOPPED: i32 = Ended::Stopped.exit_code() as i32;
const INTERRUPTED: i32 = Ended::Interrupted.exit_code() as i32;

/// How long a learner may take to answer: one with a large network or a large replay to read back, on a busy machine,
/// needs minutes.
const START_TIMEOUT: Duration = Duration::from_secs(600);

/// After this a slow start is reported; a learner whose run is to end gets this long to answer.
const SLOW_START: Duration = Duration::from_secs(30);

/// How long processes may take to end once asked, before they are killed.
const END_TIMEOUT: Duration = Duration::from_secs(10);

/// A learner that has not answered for so long hangs, and is killed.
const SILENCE_MAX: Duration = Duration::from_secs(30);

/// ... but only if it was asked in vain so often: else this process itself stood still.
const SILENT_ASKS_MIN: u32 = 5;

/// From the moment that an actor has left, unasked, to the start of another.
const LEFT_DELAY: Duration = Duration::from_millis(500);

fn wanted_in_words(actors: u32) -> String {
    format!("{} {} wanted", counted(actors.into(), "actor"), if actors == 1 { "is" } else { "are" })
}

/// What all processes are up to.
#[derive(Debug)]
enum Phase {
    /// Training.
    Running,
    /// All of them end, to be started anew: the learner at this moment or later.
    Anew(Duration),
    /// All of them end, for good.
    Ending(Outcome),
    /// Nothing more is to be done.
    Over,
}

/// How reachable the learner is.
#[derive(Debug)]
enum Contact {
    /// It has not answered since it was started at this moment; why it was not reached last, and whether that was said.
    Starting { since: Duration, why: String, slow: bool },
    /// It answered last at this moment, and was asked in vain so often since.
    Answering(Duration, u32),
}

impl Contact {
    fn starting(since: Duration) -> Self {
        Self::Starting { since, why: String::new(), slow: false }
    }
}

/// The supervisor.
#[derive(Debug)]
pub struct Supervisor {
    phase: Phase,
    learner: Process,
    contact: Contact,
    actors: BTreeMap<u32, Process>,
    /// Actors that are to run.
    wanted: u32,
    /// A learner has answered at some time: what fails now is not what was typed.
    begun: bool,
    /// How often the run was asked to end.
    interrupts: u32,
    /// The learner is writing its last files.
    run_ends: bool,
    /// Folder of the processes' logs, for messages.
    logs: String,
}

impl Supervisor {
    /// A supervisor of a run with so many actors at first, whose processes log to this folder.
    pub fn new(actors: u32, logs: String) -> Self {
        Self {
            phase: Phase::Running,
            learner: Process::default(),
            contact: Contact::starting(Duration::ZERO),
            actors: BTreeMap::new(),
            wanted: actors,
            begun: false,
            interrupts: 0,
            run_ends: false,
            logs,
        }
    }

    /// Whether a learner has ever answered.
    pub fn has_begun(&self) -> bool {
        self.begun
    }

    /// When [`Event::Tick`] is due next, if ever.
    pub fn deadline(&self) -> Option<Duration> {
        let start = match (&self.phase, &self.contact) {
            (Phase::Running, Contact::Starting { since, slow, .. }) if self.learner.is_up() => {
                let said = *slow && self.interrupts == 0;
                Some(*since + if said { START_TIMEOUT } else { SLOW_START })
            }
            _ => None,
        };
        self.processes().filter_map(Process::deadline).chain(start).min()
    }

    /// What is to be done after what happened at this moment, counted from any fixed one.
    pub fn handle(&mut self, event: Event, now: Duration) -> Vec<Effect> {
        let mut effects = Vec::new();
        match event {
            Event::Begin => self.start(Place::Learner, now, &mut effects),
            Event::Started(place, pid) => {
                if let Some(up) = self.process(place).up() {
                    up.pid = Some(pid);
                }
            }
            Event::Ended { place: Place::Learner, exit, last_words } => {
                self.learner_ended(&exit, &last_words, now, &mut effects);
            }
            Event::Ended { place: Place::Actor(slot), exit, last_words } => {
                self.actor_ended(slot, &exit, &last_words, now, &mut effects);
            }
            Event::Answers => self.answers(now, &mut effects),
            Event::Status(standing) => self.status(&standing, now, &mut effects),
            Event::NoAnswer(why) => self.no_answer(why, now, &mut effects),
            Event::Interrupted => self.interrupt(now, &mut effects),
            Event::Tick => self.tick(now, &mut effects),
        }
        effects
    }

    fn processes(&self) -> impl Iterator<Item = &Process> {
        std::iter::once(&self.learner).chain(self.actors.values())
    }

    fn process(&mut self, place: Place) -> &mut Process {
        match place {
            Place::Learner => &mut self.learner,
            Place::Actor(slot) => self.actors.entry(slot).or_default(),
        }
    }

    fn start(&mut self, place: Place, now: Duration, effects: &mut Vec<Effect>) {
        let process = self.process(place);
        process.state = State::Up(Up::default());
        process.restarts.started(now);
        if place == Place::Learner {
            (self.contact, self.run_ends) = (Contact::starting(now), false);
        }
        effects.push(Effect::Start(place));
    }

    fn ask_to_end(&mut self, place: Place, kill_at: Option<Duration>, effects: &mut Vec<Effect>) {
        let Some(up) = self.process(place).up() else { return };
        up.kill_at = up.kill_at.or(kill_at);
        if !std::mem::replace(&mut up.asked_to_end, true) {
            effects.push(Effect::AskToEnd(place));
        }
    }

    fn kill(&mut self, place: Place, effects: &mut Vec<Effect>) {
        if let Some(up) = self.process(place).up()
            && !std::mem::replace(&mut up.killed, true)
        {
            effects.push(Effect::Kill(place));
        }
    }

    /// Fills the slots that are wanted, and lets the others' actors go.
    fn adjust_actors(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        let may_start = matches!(self.contact, Contact::Answering(..))
            && matches!(self.phase, Phase::Running)
            && self.interrupts == 0
            && !self.run_ends;
        let wanted = self.wanted;
        for slot in 0..wanted {
            let down = self.actors.get(&slot).is_none_or(|actor| matches!(actor.state, State::Down));
            if may_start && down {
                self.start(Place::Actor(slot), now, effects);
            }
        }
        self.actors.retain(|&slot, actor| slot < wanted || actor.is_up());
        let beyond: Vec<u32> = self.actors.range(wanted..).map(|(&slot, _)| slot).collect();
        for slot in beyond {
            let before = effects.len();
            self.ask_to_end(Place::Actor(slot), None, effects);
            if effects.len() > before {
                let say = format!("{}: {} leaves", wanted_in_words(wanted), Place::Actor(slot));
                effects.push(Effect::Say(say));
            }
        }
    }

    fn answers(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        if !self.learner.is_up() || !matches!(self.phase, Phase::Running) {
            return;
        }
        self.begun = true;
        self.contact = Contact::Answering(now, 0);
        if self.interrupts > 0 {
            effects.push(Effect::StopRun);
        }
        self.adjust_actors(now, effects);
    }

    fn status(&mut self, standing: &Standing, now: Duration, effects: &mut Vec<Effect>) {
        if !matches!(self.contact, Contact::Answering(..)) {
            return;
        }
        self.contact = Contact::Answering(now, 0);
        self.run_ends |= standing.ending;
        for Hung { pid, silent_s } in &standing.hung {
            let is_it =
                |actor: &Process| matches!(&actor.state, State::Up(up) if up.pid == Some(*pid) && !up.killed);
            let slot = self.actors.iter().find(|(_, actor)| is_it(actor)).map(|(&slot, _)| slot);
            if let Some(slot) = slot {
                effects.push(Effect::Say(format!("actor-{slot} has hung for {silent_s} s and is killed")));
                self.kill(Place::Actor(slot), effects);
            }
        }
        if self.interrupts > 0 && !standing.ending && matches!(self.phase, Phase::Running) {
            // It was asked to stop and did not hear it.
            effects.push(Effect::StopRun);
        }
        if self.interrupts > 0 || self.run_ends {
            // Actors that are down are not started again.
            self.actors.retain(|_, actor| actor.is_up());
            return;
        }
        if standing.actors_wanted > self.wanted {
            effects.push(Effect::Say(wanted_in_words(standing.actors_wanted)));
        }
        self.wanted = standing.actors_wanted;
        self.adjust_actors(now, effects);
    }

    fn no_answer(&mut self, why: String, now: Duration, effects: &mut Vec<Effect>) {
        match &mut self.contact {
            Contact::Starting { why: last, .. } => *last = why,
            Contact::Answering(since, asks) => {
                *asks += 1;
                let silent = now.saturating_sub(*since);
                let hangs = silent >= SILENCE_MAX && *asks >= SILENT_ASKS_MIN && !self.run_ends;
                if hangs && self.learner.up().is_some_and(|up| !up.killed) {
                    let seconds = silent.as_secs();
                    effects.push(Effect::Say(format!(
                        "the learner has not answered for {seconds} s and is killed ({why})"
                    )));
                    self.kill(Place::Learner, effects);
                }
            }
        }
    }

    fn learner_ended(&mut self, exit: &Exit, last_words: &str, now: Duration, effects: &mut Vec<Effect>) {
        let was_anew = matches!(self.phase, Phase::Anew(_));
        self.learner.state = State::Down;
        if was_anew || matches!(self.phase, Phase::Ending(_) | Phase::Over) {
            self.go_on_if_all_are_down(effects);
            return;
        }
        let log = format!("{}/learner.log", self.logs);
        let died = format!("the learner {exit}: {last_words} (log: {log})");
        self.contact = Contact::starting(now);
        match exit {
            // It has ended the run gracefully, and its summary says how.
            Exit::Code(0 | STOPPED) if self.interrupts == 0 => self.end(Outcome::Finished, now, effects),
            Exit::Code(0 | STOPPED | INTERRUPTED) if self.interrupts > 0 => {
                self.end(Outcome::Interrupted, now, effects);
            }
            // A signal ended the learner alone; the run goes on.
            Exit::Code(INTERRUPTED) => self.restart(Place::Learner, exit, last_words, now, effects),
            _ if self.interrupts > 0 => self.fail(false, died, now, effects),
            // What was typed or given is wrong, and will be the second time.
            Exit::Code(2) => self.fail(true, last_words.to_owned(), now, effects),
            // It cannot have now what it had before: memory, a port, room on the disk.
            Exit::Code(code) if *code == i32::from(UNAVAILABLE) && self.begun => {
                self.begin_anew(&died, last_words, now, effects);
            }
            Exit::Code(code) if *code == i32::from(UNAVAILABLE) => {
                self.fail(true, last_words.to_owned(), now, effects);
            }
            // What it said itself would be no better a second time.
            Exit::Code(_) => self.fail(false, died, now, effects),
            Exit::NotStarted(why) if !self.begun => {
                self.fail(false, format!("cannot start the learner: {why}"), now, effects);
            }
            // What ended it from outside may be.
            Exit::Signal(_) | Exit::NotStarted(_) => {
                self.restart(Place::Learner, exit, last_words, now, effects);
            }
        }
    }

    fn actor_ended(
        &mut self,
        slot: u32,
        exit: &Exit,
        last_words: &str,
        now: Duration,
        effects: &mut Vec<Effect>,
    ) {
        let Some(actor) = self.actors.get_mut(&slot) else { return };
        let left = actor.up().is_some_and(|up| up.asked_to_end);
        actor.state = State::Down;
        if !matches!(self.phase, Phase::Running) {
            self.go_on_if_all_are_down(effects);
            return;
        }
        if self.interrupts > 0 || self.run_ends || slot >= self.wanted {
            self.actors.remove(&slot);
        } else if left {
            // It was not wanted for a while, and is again.
            self.adjust_actors(now, effects);
        } else if *exit == Exit::Code(2) {
            // What was given is wrong, and will be the second time.
            self.fail(true, format!("{}: {last_words}", Place::Actor(slot)), now, effects);
        } else if *exit == Exit::Code(INCOMPATIBLE.into()) {
            // Nor would the next one understand this learner.
            self.fail(false, format!("{}: {last_words}", Place::Actor(slot)), now, effects);
        } else {
            self.restart(Place::Actor(slot), exit, last_words, now, effects);
        }
    }

    /// Starts a process again that died, now or later; gives the run up when it dies again and again.
    fn restart(
        &mut self,
        place: Place,
        exit: &Exit,
        last_words: &str,
        now: Duration,
        effects: &mut Vec<Effect>,
    ) {
        let Some(delay) = self.process(place).restarts.died(now) else {
            return self.give_up(place, last_words, now, effects);
        };
        if *exit == Exit::Code(0) {
            // A run that ends lets its actors go before it says so: then none is to be started.
            let say = format!("{place} had left and is started again");
            self.process(place).state = State::Due(now + delay.max(LEFT_DELAY), Some(say));
            return;
        }
        let when = if delay.is_zero() { String::new() } else { format!(" in {} s", delay.as_secs_f64()) };
        let name = if place == Place::Learner { "the learner".to_owned() } else { place.to_string() };
        effects.push(Effect::Say(format!("{name} {exit} and is restarted{when}")));
        if delay.is_zero() {
            self.start(place, now, effects);
        } else {
            self.process(place).state = State::Due(now + delay, None);
        }
    }

    fn give_up(&mut self, place: Place, last_words: &str, now: Duration, effects: &mut Vec<Effect>) {
        let message = format!("{place} died {DEATHS_MAX} times in a row and is given up: {last_words}");
        self.fail(false, message, now, effects);
    }

    /// Ends all processes, then starts all of them: a learner could not begin beside the actors there are.
    fn begin_anew(&mut self, why: &str, last_words: &str, now: Duration, effects: &mut Vec<Effect>) {
        let Some(delay) = self.learner.restarts.died(now) else {
            return self.give_up(Place::Learner, last_words, now, effects);
        };
        effects.push(Effect::Say(format!("{why}; the actors are started anew too")));
        self.phase = Phase::Anew(now + delay);
        self.end_processes(now, effects);
        self.go_on_if_all_are_down(effects);
    }

    fn fail(&mut self, input: bool, message: String, now: Duration, effects: &mut Vec<Effect>) {
        self.end(Outcome::Failed { input, message }, now, effects);
    }

    fn end(&mut self, outcome: Outcome, now: Duration, effects: &mut Vec<Effect>) {
        self.phase = Phase::Ending(outcome);
        self.end_processes(now, effects);
        self.go_on_if_all_are_down(effects);
    }

    fn end_processes(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        let slots: Vec<u32> = self.actors.keys().copied().collect();
        for place in slots.into_iter().map(Place::Actor).chain([Place::Learner]) {
            let process = self.process(place);
            if matches!(process.state, State::Due(..)) {
                process.state = State::Down;
            }
            self.ask_to_end(place, Some(now + END_TIMEOUT), effects);
        }
    }

    /// The end, or the new beginning, once no process lives.
    fn go_on_if_all_are_down(&mut self, effects: &mut Vec<Effect>) {
        if self.processes().any(Process::is_up) {
            return;
        }
        match std::mem::replace(&mut self.phase, Phase::Over) {
            Phase::Anew(due) => {
                self.phase = Phase::Running;
                self.actors.clear();
                self.learner.state = State::Due(due, None);
                effects.push(Effect::RemoveSharedMemory);
            }
            Phase::Ending(outcome) => effects.push(Effect::Over(outcome)),
            other => self.phase = other,
        }
    }

    fn tick(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        let slots: Vec<u32> = self.actors.keys().copied().collect();
        for place in slots.into_iter().map(Place::Actor).chain([Place::Learner]) {
            match &self.process(place).state {
                State::Due(at, say) if *at <= now => {
                    effects.extend(say.clone().map(Effect::Say));
                    self.start(place, now, effects);
                }
                State::Up(Up { kill_at: Some(at), .. }) if *at <= now => self.kill(place, effects),
                _ => {}
            }
        }
        self.look_at_start(now, effects);
    }

    /// A learner that takes long to begin is waited for with a word; one that takes too long is given up.
    fn look_at_start(&mut self, now: Duration, effects: &mut Vec<Effect>) {
        if !self.learner.is_up() || !matches!(self.phase, Phase::Running) {
            return;
        }
        let logs = &self.logs;
        let Contact::Starting { since, why, slow } = &mut self.contact else { return };
        let waited = now.saturating_sub(*since);
        let why = if why.is_empty() { String::new() } else { format!(": {why}") };
        let log = format!("(log: {logs}/learner.log)");
        if self.interrupts > 0 && waited >= SLOW_START {
            return self.end(Outcome::Interrupted, now, effects);
        }
        if waited >= START_TIMEOUT {
            let message =
                format!("the learner does not answer after {} s{why} {log}", START_TIMEOUT.as_secs());
            return if self.begun {
                self.begin_anew(&message, &message, now, effects);
            } else {
                self.fail(false, message, now, effects);
            };
        }
        if waited >= SLOW_START && !std::mem::replace(slow, true) {
            let (slow, limit) = (SLOW_START.as_secs(), START_TIMEOUT.as_secs());
            effects.push(Effect::Say(format!(
                "the learner has not answered for {slow} s{why}; it is waited for up to {limit} s {log}"
            )));
        }
    }
}
