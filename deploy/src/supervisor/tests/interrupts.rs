//! Ctrl-C once, twice and three times.

use super::*;

#[test]
fn a_learner_that_did_not_hear_that_its_run_is_to_end_is_told_again() {
    let mut world = World::new(1);
    world.tell(Event::Interrupted);
    world.tell(Event::NoAnswer("deadline".into()));
    let standing = |ending| Event::Status(Standing { actors_wanted: 1, hung: vec![], ending });
    let mut told = |ending| world.supervisor.handle(standing(ending), world.now);
    assert_eq!(told(false), [Effect::StopRun]);
    assert_eq!(told(false), [Effect::StopRun]);
    assert!(told(true).is_empty(), "it heard");
}

#[test]
fn a_second_interrupt_ends_retries_and_a_third_kills() {
    let says = |effects: &[Effect], words: &str| {
        assert!(matches!(&effects[0], Effect::Say(line) if line.contains(words)), "{effects:?}");
    };
    let mut world = World::new(1);
    let mut interrupt = || world.supervisor.handle(Event::Interrupted, seconds(1));
    let first = interrupt();
    says(&first, "a second interrupt ends the retries");
    assert_eq!(first[1..], [Effect::StopRun]);
    let second = interrupt();
    says(&second, "a third interrupt kills");
    assert_eq!(second[1..], [Effect::StopRun]);
    let third = interrupt();
    says(&third, "the processes are killed");
    for place in [Place::Learner, Place::Actor(0)] {
        assert!(third.contains(&Effect::Kill(place)), "{third:?}");
    }
    assert!(interrupt().is_empty(), "there is nothing more to be done");
    for place in [Place::Learner, Place::Actor(0)] {
        world.alive.get_mut(&place).unwrap().killed = true;
    }
    world.settle();
    let Some(Outcome::Failed { input: false, message }) = world.over else { panic!("{:?}", world.over) };
    assert!(message.contains("interrupted three times") && message.contains("--resume"), "{message}");
}

#[test]
fn a_learner_that_begins_is_not_waited_for_after_a_second_interrupt() {
    let mut supervisor = Supervisor::new(1, "logs".into());
    supervisor.handle(Event::Begin, seconds(0));
    supervisor.handle(Event::Interrupted, seconds(1));
    let second = supervisor.handle(Event::Interrupted, seconds(2));
    assert_eq!(second[1..], [Effect::AskToEnd(Place::Learner)]);
    assert_eq!(supervisor.handle(Event::Interrupted, seconds(3))[1..], [Effect::Kill(Place::Learner)]);
}

#[test]
fn a_third_interrupt_changes_no_end_that_the_learner_came_to() {
    let mut world = World::new(1);
    world.alive.get_mut(&Place::Actor(0)).unwrap().hung = true;
    world.tell(Event::Interrupted);
    world.ends(Place::Learner, Exit::Code(INTERRUPTED));
    assert_eq!(world.over, None, "an actor hangs");
    world.tell(Event::Interrupted);
    world.tell(Event::Interrupted);
    world.settle();
    assert_eq!(world.over, Some(Outcome::Interrupted));
}
