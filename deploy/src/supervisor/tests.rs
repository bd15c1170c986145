//! The supervisor's decisions: tables of what was seen to go wrong, and random courses of everything that may happen.

mod interrupts;

use super::*;
use proptest::prelude::*;

const TERM: i32 = 15;
const KILL: i32 = 9;

fn seconds(s: u64) -> Duration {
    Duration::from_secs(s)
}

/// A process of the world around a supervisor.
#[derive(Debug)]
struct Alive {
    pid: u32,
    started: Duration,
    asked: bool,
    killed: bool,
    hung: bool,
}

/// A world that does what the supervisor wants, in memory.
struct World {
    supervisor: Supervisor,
    now: Duration,
    alive: BTreeMap<Place, Alive>,
    /// Deaths in a row, as the test counts them.
    deaths: BTreeMap<Place, u32>,
    wanted: u32,
    next_pid: u32,
    said: Vec<String>,
    over: Option<Outcome>,
}

impl World {
    /// A run with so many actors, all of them there.
    fn new(actors: u32) -> Self {
        let mut world = Self {
            supervisor: Supervisor::new(actors, "logs".into()),
            now: Duration::ZERO,
            alive: BTreeMap::new(),
            deaths: BTreeMap::new(),
            wanted: actors,
            next_pid: 100,
            said: vec![],
            over: None,
        };
        world.tell(Event::Begin);
        world.tell(Event::Answers);
        world
    }

    fn tell(&mut self, event: Event) {
        let mut events = vec![event];
        while let Some(event) = events.pop() {
            for effect in self.supervisor.handle(event, self.now) {
                match effect {
                    Effect::Start(place) => {
                        let (pid, started) = (self.next_pid, self.now);
                        self.next_pid += 1;
                        let new = Alive { pid, started, asked: false, killed: false, hung: false };
                        let before = self.alive.insert(place, new);
                        assert!(before.is_none(), "{place} is there already: {before:?}");
                        events.push(Event::Started(place, pid));
                    }
                    Effect::AskToEnd(place) => self.alive.get_mut(&place).unwrap().asked = true,
                    Effect::Kill(place) => self.alive.get_mut(&place).unwrap().killed = true,
                    Effect::Say(line) => self.said.push(line),
                    Effect::RemoveSharedMemory => assert!(self.alive.is_empty(), "its processes live"),
                    Effect::Over(outcome) => {
                        assert!(self.alive.is_empty(), "over, and there are {:?}", self.alive);
                        self.over = Some(outcome);
                    }
                    Effect::StopRun => {}
                }
            }
        }
    }

    fn ends(&mut self, place: Place, exit: Exit) {
        let Some(Alive { started, asked, .. }) = self.alive.remove(&place) else { return };
        let deaths = self.deaths.entry(place).or_default();
        if self.now - started >= restarts::HEALTHY_AFTER {
            *deaths = 0;
        }
        *deaths += u32::from(!asked);
        self.tell(Event::Ended { place, exit, last_words: "so it goes".into() });
    }

    /// What the learner would say: how many actors are wanted, and who hangs.
    fn status(&mut self) {
        if self.alive.contains_key(&Place::Learner) {
            let hung = self.alive.values().filter(|process| process.hung);
            let hung = hung.map(|process| Hung { pid: process.pid, silent_s: 30 }).collect();
            let standing = Standing { actors_wanted: self.wanted, hung, ending: false };
            self.tell(Event::Status(standing));
        }
    }

    /// Time goes by; a learner that is there answers.
    fn pass(&mut self, time: Duration) {
        self.answer();
        let until = self.now + time;
        while let Some(at) = self.supervisor.deadline().filter(|&at| at <= until) {
            self.now = at.max(self.now);
            self.tell(Event::Tick);
        }
        self.now = until;
    }

    fn answer(&mut self) {
        if self.alive.contains_key(&Place::Learner) {
            self.tell(Event::Answers);
        }
    }

    /// Who was killed is dead, who was asked to end has ended, a new learner answers.
    fn settle(&mut self) {
        for _ in 0..200 {
            self.status();
            let due = |process: &Alive| process.killed || (process.asked && !process.hung);
            let ending: Vec<_> =
                self.alive.iter().filter(|(_, p)| due(p)).map(|(&place, p)| (place, p.killed)).collect();
            for (place, killed) in ending {
                self.ends(place, if killed { Exit::Signal(KILL) } else { Exit::Code(0) });
            }
            self.pass(Duration::from_millis(200));
        }
    }

    fn actors(&self) -> Vec<u32> {
        let slot = |place: &Place| match place {
            Place::Learner => None,
            Place::Actor(slot) => Some(*slot),
        };
        self.alive.keys().filter_map(slot).collect()
    }
}

#[test]
fn an_actor_that_is_told_to_leave_is_replaced_in_its_own_slot() {
    for slot in 0..2 {
        let mut world = World::new(2);
        // It shuts down gracefully on TERM and INT: exit code 0.
        world.ends(Place::Actor(slot), Exit::Code(0));
        world.status();
        assert_eq!(world.actors(), [1 - slot], "the run may be ending");
        world.pass(LEFT_DELAY);
        assert_eq!(world.actors(), [0, 1]);
        assert_eq!(world.said, [format!("actor-{slot} had left and is started again")]);
    }
}

#[test]
fn counts_that_change_faster_than_actors_leave() {
    let mut world = World::new(2);
    for wanted in [6, 1, 6, 2, 5, 4, 1, 3] {
        world.wanted = wanted;
        world.status();
        // The actor that was asked to leave still rolls its episode.
        assert!(world.actors().iter().max() < Some(&6));
    }
    world.settle();
    assert_eq!((world.actors(), &world.over), (vec![0, 1, 2], &None));
}

#[test]
fn a_hung_actor_is_killed_once_and_replaced() {
    let mut world = World::new(2);
    world.alive.get_mut(&Place::Actor(1)).unwrap().hung = true;
    world.status();
    world.status();
    assert_eq!(world.said, ["actor-1 has hung for 30 s and is killed"]);
    world.settle();
    assert_eq!(world.actors(), [0, 1]);
    assert!(!world.alive[&Place::Actor(1)].hung);
}

#[test]
fn what_fails_for_six_seconds_ends_no_run() {
    // Shared memory is full: a process that starts writes to it and dies at once.
    let mut world = World::new(2);
    let begun = world.now;
    while world.now - begun < seconds(6) {
        for slot in world.actors() {
            world.ends(Place::Actor(slot), Exit::Signal(7));
        }
        world.pass(Duration::from_millis(50));
    }
    world.settle();
    assert_eq!((world.actors(), &world.over), (vec![0, 1], &None));
    assert!(world.deaths.values().all(|&deaths| deaths == 6), "at 0, 0, 0.25, 0.75, 1.75 and 3.75 s");
}

#[test]
fn a_process_that_keeps_dying_is_given_up() {
    for place in [Place::Learner, Place::Actor(1)] {
        let mut world = World::new(2);
        for _ in 0..DEATHS_MAX {
            assert_eq!(world.over, None);
            world.ends(place, Exit::Signal(KILL));
            world.pass(seconds(15));
        }
        world.settle();
        let message = format!("{place} died 10 times in a row and is given up: so it goes");
        assert_eq!(world.over, Some(Outcome::Failed { input: false, message }));
    }
}

#[test]
fn what_cannot_pass_is_not_tried_again() {
    let mut wrong = World::new(2);
    wrong.ends(Place::Actor(0), Exit::Code(2));
    wrong.settle();
    let message = "actor-0: so it goes".to_owned();
    assert_eq!(wrong.over, Some(Outcome::Failed { input: true, message }));

    for (code, input, message) in [
        (1, false, "the learner ended with exit code 1: so it goes (log: logs/learner.log)"),
        (2, true, "so it goes"),
    ] {
        let mut failed = World::new(2);
        failed.ends(Place::Learner, Exit::Code(code));
        failed.settle();
        assert_eq!(failed.over, Some(Outcome::Failed { input, message: message.to_owned() }));
    }
}

#[test]
fn a_learner_that_cannot_begin_beside_its_actors_begins_without_them() {
    let mut world = World::new(2);
    world.ends(Place::Learner, Exit::Signal(KILL));
    world.ends(Place::Learner, Exit::Code(UNAVAILABLE.into()));
    assert!(world.alive.values().all(|actor| actor.asked), "the actors are asked to end");
    world.settle();
    assert_eq!((world.actors(), world.over), (vec![0, 1], None));
}

#[test]
fn a_learner_that_never_began_is_not_started_again() {
    let mut supervisor = Supervisor::new(1, "logs".into());
    supervisor.handle(Event::Begin, Duration::ZERO);
    let exit = Exit::Code(UNAVAILABLE.into());
    let ended = Event::Ended { place: Place::Learner, exit, last_words: "/dev/shm is too small".into() };
    let message = "/dev/shm is too small".to_owned();
    let over = Effect::Over(Outcome::Failed { input: true, message });
    assert_eq!(supervisor.handle(ended, seconds(1)), [over]);
}

#[test]
fn a_learner_that_stands_still_is_killed_unless_this_process_did() {
    let mut world = World::new(1);
    world.now += seconds(100);
    world.tell(Event::NoAnswer("deadline".into()));
    assert!(!world.alive[&Place::Learner].killed, "asked once, after a long sleep of the supervisor");
    for _ in 0..5 {
        world.now += seconds(2);
        world.tell(Event::NoAnswer("deadline".into()));
    }
    assert!(world.alive[&Place::Learner].killed);
    world.settle();
    assert_eq!((world.actors(), world.over), (vec![0], None));
}

#[test]
fn an_interrupt_ends_the_run_whatever_the_learner_is_doing() {
    // Training.
    let mut training = World::new(2);
    training.tell(Event::Interrupted);
    training.ends(Place::Actor(0), Exit::Code(0));
    training.ends(Place::Learner, Exit::Code(INTERRUPTED));
    training.settle();
    assert_eq!(training.over, Some(Outcome::Interrupted));
    // Waiting to be started again.
    let mut waiting = World::new(2);
    waiting.ends(Place::Learner, Exit::Signal(KILL));
    waiting.ends(Place::Learner, Exit::Signal(KILL));
    waiting.tell(Event::Interrupted);
    waiting.settle();
    assert_eq!(waiting.over, Some(Outcome::Interrupted));
    // Beginning: it is asked once it answers.
    let mut beginning = Supervisor::new(2, "logs".into());
    beginning.handle(Event::Begin, seconds(0));
    let said = beginning.handle(Event::Interrupted, seconds(1));
    let [Effect::Say(line)] = &said[..] else { panic!("{said:?}") };
    assert!(line.starts_with("interrupted: shutting the run down gracefully; a second interrupt"), "{line}");
    assert_eq!(beginning.handle(Event::Answers, seconds(2)), [Effect::StopRun]);
}

#[test]
fn actors_that_go_while_the_run_ends_are_not_replaced() {
    let mut world = World::new(2);
    let standing = Standing { actors_wanted: 2, hung: vec![], ending: true };
    world.tell(Event::Status(standing));
    world.ends(Place::Actor(0), Exit::Code(0));
    world.pass(seconds(20));
    assert_eq!(world.actors(), [1]);
    world.ends(Place::Learner, Exit::Code(0));
    world.settle();
    assert_eq!(world.over, Some(Outcome::Finished));
}

#[test]
fn a_learner_that_a_signal_asked_to_end_is_restarted_and_one_that_was_stopped_is_not() {
    let mut world = World::new(1);
    world.ends(Place::Learner, Exit::Code(INTERRUPTED));
    world.settle();
    assert_eq!((world.actors(), &world.over), (vec![0], &None));
    assert!(world.alive.contains_key(&Place::Learner));
    world.ends(Place::Learner, Exit::Code(STOPPED));
    world.settle();
    assert_eq!(world.over, Some(Outcome::Finished));
}

/// What may happen, as small numbers that choose among what is there.
#[derive(Clone, Debug)]
enum Happens {
    /// A signal; TERM and INT let a process shut down gracefully, unless it hangs.
    Signal {
        which: usize,
        signal: i32,
    },
    /// An actor stops and gives no sign of life.
    Hang {
        which: usize,
    },
    /// `rit ctl set actors.count`, and whether the supervisor looks at once.
    Count {
        wanted: u32,
        seen: bool,
    },
    /// A process that was asked to end, or killed, has ended.
    Depart {
        which: usize,
    },
    Look,
    Answer,
    Pass {
        ms: u64,
    },
}

fn happens() -> impl Strategy<Value = Happens> {
    let signal = prop_oneof![Just(1), Just(2), Just(3), Just(7), Just(KILL), Just(11), Just(TERM)];
    prop_oneof![
        4 => (0..8_usize, signal).prop_map(|(which, signal)| Happens::Signal { which, signal }),
        1 => (0..8_usize).prop_map(|which| Happens::Hang { which }),
        3 => (1..7_u32, any::<bool>()).prop_map(|(wanted, seen)| Happens::Count { wanted, seen }),
        3 => (0..8_usize).prop_map(|which| Happens::Depart { which }),
        3 => Just(Happens::Look),
        2 => Just(Happens::Answer),
        3 => (0..20_000_u64).prop_map(|ms| Happens::Pass { ms }),
    ]
}

proptest! {
    /// Whatever happens in whatever order: no place holds two processes (the world checks it at every start), and
    /// once nothing more happens, there is one actor in every slot that is wanted and in no other. A run is given up
    /// only when one process died ten times in a row.
    #[test]
    fn every_slot_is_filled_once(actors in 1..5_u32, course in prop::collection::vec(happens(), 0..120)) {
        let mut world = World::new(actors);
        for event in course {
            if world.over.is_some() {
                break;
            }
            let nth = |world: &World, which: usize| {
                let places: Vec<Place> = world.alive.keys().copied().collect();
                (!places.is_empty()).then(|| places[which % places.len()])
            };
            match event {
                Happens::Signal { which, signal } => {
                    let Some(place) = nth(&world, which) else { continue };
                    let in_order = matches!(signal, 2 | TERM) && place != Place::Learner;
                    if in_order && world.alive[&place].hung {
                        continue;
                    }
                    world.ends(place, if in_order { Exit::Code(0) } else { Exit::Signal(signal) });
                }
                Happens::Hang { which } => {
                    let place = nth(&world, which).filter(|&place| place != Place::Learner);
                    if let Some(process) = place.and_then(|place| world.alive.get_mut(&place)) {
                        process.hung = true;
                    }
                }
                Happens::Count { wanted, seen } => {
                    world.wanted = wanted;
                    if seen {
                        world.status();
                    }
                }
                Happens::Depart { which } => {
                    let Some(place) = nth(&world, which) else { continue };
                    let Alive { asked, killed, hung, .. } = world.alive[&place];
                    if killed {
                        world.ends(place, Exit::Signal(KILL));
                    } else if asked && !hung {
                        world.ends(place, Exit::Code(0));
                    }
                }
                Happens::Look => world.status(),
                Happens::Answer => world.answer(),
                Happens::Pass { ms } => world.pass(Duration::from_millis(ms)),
            }
        }
        world.settle();
        if let Some(outcome) = &world.over {
            let given_up = world.deaths.values().any(|&deaths| deaths >= DEATHS_MAX);
            prop_assert!(given_up, "{outcome:?} after {:?}", world.deaths);
        } else {
            prop_assert_eq!(world.actors(), (0..world.wanted).collect::<Vec<_>>());
        }
    }
}

#[test]
fn a_learner_that_takes_long_to_begin_is_waited_for_with_a_word() {
    let (mut supervisor, at) = (Supervisor::new(1, "logs".into()), seconds);
    supervisor.handle(Event::Begin, at(0));
    assert_eq!(supervisor.deadline(), Some(at(30)));
    let said = supervisor.handle(Event::Tick, at(30));
    let [Effect::Say(line)] = &said[..] else { panic!("{said:?}") };
    assert_eq!(
        line,
        "the learner has not answered for 30 s; it is waited for up to 600 s (log: logs/learner.log)"
    );
    assert_eq!(supervisor.deadline(), Some(at(600)));
    assert!(supervisor.handle(Event::Tick, at(31)).is_empty(), "it is said once");
    // The end does not wait so long.
    supervisor.handle(Event::Interrupted, at(40));
    assert_eq!(supervisor.deadline(), Some(at(30)));
    assert_eq!(supervisor.handle(Event::Tick, at(40)), [Effect::AskToEnd(Place::Learner)]);
    let ended = Event::Ended { place: Place::Learner, exit: Exit::Signal(KILL), last_words: String::new() };
    assert_eq!(supervisor.handle(ended, at(50)), [Effect::Over(Outcome::Interrupted)]);

    // One that never answers is given up.
    let mut supervisor = Supervisor::new(1, "logs".into());
    supervisor.handle(Event::Begin, at(0));
    supervisor.handle(Event::Tick, at(30));
    assert_eq!(supervisor.handle(Event::Tick, at(600)), [Effect::AskToEnd(Place::Learner)]);
}

#[test]
fn an_actor_that_cannot_use_what_the_learner_sends_ends_the_run_at_once() {
    let mut supervisor = Supervisor::new(1, "logs".into());
    for event in [Event::Begin, Event::Answers] {
        supervisor.handle(event, seconds(0));
    }
    let last_words = "weights 7: a piece begins at byte 8, where 4 should come; use one build".to_owned();
    let exit = Exit::Code(INCOMPATIBLE.into());
    let ended = Event::Ended { place: Place::Actor(0), exit, last_words: last_words.clone() };
    assert_eq!(supervisor.handle(ended, seconds(1)), [Effect::AskToEnd(Place::Learner)]);
    let ended = Event::Ended { place: Place::Learner, exit: Exit::Code(130), last_words: String::new() };
    let message = format!("actor-0: {last_words}");
    let failed = Outcome::Failed { input: false, message };
    assert_eq!(supervisor.handle(ended, seconds(2)), [Effect::Over(failed)]);
}
