//! A short simulated soak; and the faults that were once there, put back, each of which it must find.

use super::{
    world::{Machines, Real, Supervises, World},
    *,
};
use crate::supervisor::{Effect, Event, Exit, Place, Supervisor};
use rit_learner::coordinator::Joining;
use std::{collections::BTreeMap, time::Duration};

fn config() -> Config {
    experiments::load("matrix-game", &[]).unwrap().config
}

#[test]
fn no_promise_is_broken() {
    let report = simulate(&config(), 3000, 1);
    if let Some(first) = report.failures.first() {
        course(&config(), first.seed).iter().for_each(|line| println!("{line}"));
    }
    assert_eq!(report.broken, 0, "{}", in_words(&report));
    assert!(report.deaths > 9000 && report.learners_resumed > 100, "{report:?}");
}

#[test]
fn a_scenario_is_a_fact_of_its_seed() {
    for seed in 0..20 {
        assert_eq!(course(&config(), seed), course(&config(), seed));
    }
    assert_ne!(course(&config(), 1), course(&config(), 2));
}

/// How many of so many scenarios find a fault, and what the first says.
fn found<M: Machines>(scenarios: u64) -> (usize, String) {
    let config = config();
    let broken: Vec<String> =
        (0..scenarios).filter_map(|seed| World::<M>::new(&config, seed).run().1).collect();
    (broken.len(), broken.first().cloned().unwrap_or_default())
}

/// A supervisor that keeps its actors in a list, as it once did: one that leaves moves the others up, and the one that is
/// started gets the name of its place in the list.
struct NamesByIndex {
    inner: Supervisor,
    /// By slot, the name of who fills it.
    names: BTreeMap<u32, u32>,
}

impl Supervises for NamesByIndex {
    fn new(actors: u32) -> Self {
        Self { inner: Supervisor::new(actors, String::new()), names: BTreeMap::new() }
    }

    fn handle(&mut self, event: Event, now: Duration) -> Vec<Effect> {
        let slot_of = |names: &BTreeMap<u32, u32>, place| match place {
            Place::Learner => Place::Learner,
            Place::Actor(name) => {
                let slot = names.iter().find(|(_, other)| **other == name).map(|(&slot, _)| slot);
                Place::Actor(slot.unwrap_or(name))
            }
        };
        let event = match event {
            Event::Started(place, pid) => Event::Started(slot_of(&self.names, place), pid),
            Event::Ended { place, exit, last_words } => {
                let place = slot_of(&self.names, place);
                if let (Place::Actor(slot), Exit::Code(0)) = (place, &exit) {
                    self.names.remove(&slot);
                }
                Event::Ended { place, exit, last_words }
            }
            event => event,
        };
        let mut effects = self.inner.handle(event, now);
        for effect in &mut effects {
            if let Effect::Start(place) | Effect::AskToEnd(place) | Effect::Kill(place) = effect
                && let Place::Actor(slot) = place
            {
                let next = self.names.len() as u32;
                *slot = *self.names.entry(*slot).or_insert(next);
            }
        }
        effects
    }

    fn deadline(&self) -> Option<Duration> {
        self.inner.deadline()
    }
}

/// A supervisor that restarts at once what died.
struct Hasty {
    inner: Supervisor,
    /// Its clock runs ahead by the delays that it does not wait for.
    ahead: Duration,
}

impl Supervises for Hasty {
    fn new(actors: u32) -> Self {
        Self { inner: Supervisor::new(actors, String::new()), ahead: Duration::ZERO }
    }

    fn handle(&mut self, event: Event, now: Duration) -> Vec<Effect> {
        let died = matches!(event, Event::Ended { .. });
        let mut effects = self.inner.handle(event, now + self.ahead);
        let starts = |effects: &[Effect]| effects.iter().any(|effect| matches!(effect, Effect::Start(_)));
        if died
            && !starts(&effects)
            && let Some(due) = self.inner.deadline().filter(|&due| due > now + self.ahead)
        {
            self.ahead = due - now;
            effects.extend(self.inner.handle(Event::Tick, due));
        }
        effects
    }

    fn deadline(&self) -> Option<Duration> {
        self.inner.deadline().map(|due| due.saturating_sub(self.ahead))
    }
}

struct ByIndex;

impl Machines for ByIndex {
    type Supervisor = NamesByIndex;
}

struct WithoutDelay;

impl Machines for WithoutDelay {
    type Supervisor = Hasty;
}

/// Actors are known by their names alone, so a successor that comes before its predecessor's end is noticed is refused.
struct ByName;

impl Machines for ByName {
    type Supervisor = Supervisor;

    fn joining(joining: Joining) -> Joining {
        Joining { slot: None, ..joining }
    }
}

#[test]
fn faults_that_are_put_back_are_found() {
    let scenarios = 400;
    assert_eq!(found::<Real>(scenarios), (0, String::new()));
    let (times, what) = found::<ByIndex>(scenarios);
    assert!(times > 10 && what.contains("is started as process"), "{times} times: {what}");
    let (times, what) = found::<ByName>(scenarios);
    assert!(times > 10 && what.contains("is there already"), "{times} times: {what}");
    let (times, what) = found::<WithoutDelay>(scenarios);
    assert!(times > 0 && what.contains("is given up"), "{times} times: {what}");
}
