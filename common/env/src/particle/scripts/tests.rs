use super::*;
use crate::Script;
use crate::{
    Embedded, Split, TaskSet,
    rollout::{Job, Rollout, all_rolled},
};
use rand::RngExt as _;
use rit_episode::{Choice, Exploration, Policy as _, RunSeed, Stream};
use std::sync::Arc;

/// Mean total reward of a script over testing tasks, mixed evenly, and its standard error.
fn mean_reward(set: TaskSet, mut script: Script, episodes: usize) -> (f64, f64) {
    let tasks = set.tasks(Split::Testing);
    let job = |number: usize| Job {
        number: number as u64,
        weights_version: 0,
        choice: Choice::Greedy,
        task: Some(number % tasks.len()),
    };
    let jobs: Vec<Job> = (0..episodes).map(job).collect();
    let mut rollout = Rollout::new(tasks.clone(), Arc::new(Embedded::default()), RunSeed(0), true);
    let rewards: Vec<f64> = all_rolled(rollout.roll(&mut script, &jobs))
        .unwrap()
        .iter()
        .map(rit_episode::Episode::total_reward)
        .collect();
    let n = episodes as f64;
    let mean = rewards.iter().sum::<f64>() / n;
    let variance = rewards.iter().map(|reward| (reward - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

/// The figures expected are those of another implementation of the same rules, written apart from this one, in
/// f64 and with other random numbers: thousands of episodes each, so their own error is small beside ours.
#[track_caller]
fn check_calibration(set: TaskSet, script: Script, episodes: usize, expected: f64) {
    let (mean, error) = mean_reward(set, script, episodes);
    assert!((mean - expected).abs() < 3.5 * error, "{set}, {script}: {mean} ± {error}, expected {expected}");
}

#[test]
fn cooperative_navigation_pays_scripts_what_it_should() {
    use TaskSet::CooperativeNavigation as Set;
    check_calibration(Set, Script::Random, 2000, -529.5);
    check_calibration(Set, Script::Still, 2000, -489.0);
    check_calibration(Set, Script::NearestAssignment, 2000, -252.8);
}

#[test]
fn predator_and_prey_pays_scripts_what_it_should() {
    use TaskSet::{PredatorPrey as Plain, PredatorPreyPro as Pro};
    check_calibration(Plain, Script::Random, 300, 0.24);
    check_calibration(Plain, Script::Chase, 300, 8.92);
    check_calibration(Pro, Script::Random, 300, -82.1);
    check_calibration(Pro, Script::Chase, 300, -48.0);
}

/// Entities of these kinds and places, at rest unless a velocity is given to the first.
fn observation(entities: &[(BodyKind, Vector)], first_velocity: Vector) -> Observation {
    let n_agents = entities.iter().filter(|(kind, _)| *kind == BodyKind::Agent).count();
    // Last actions follow the features, as in an episode.
    let mut observation = Observation::new(n_agents, entities.len(), KIND.end + 5, 5);
    for (entity, &(kind, position)) in entities.iter().enumerate() {
        let features = observation.entity_mut(entity);
        features[POSITION].copy_from_slice(&position);
        features[KIND][kind as usize] = 1.0;
    }
    observation.entity_mut(0)[VELOCITY].copy_from_slice(&first_velocity);
    observation.see_and_allow_all();
    observation
}

fn act(mut script: Script, observation: &Observation) -> Vec<Action> {
    let mut actions = vec![Action::MAX; observation.n_agents()];
    script.act(&mut [Turn {
        slot: 0,
        observation,
        previous_reward: 0.0,
        exploration: &mut Exploration::new(
            Choice::Greedy,
            0.0,
            observation.n_agents(),
            RunSeed(0).stream(Stream::Exploration, 0),
        ),
        actions: &mut actions,
    }]);
    actions
}

#[test]
fn steers_along_the_longer_axis_and_counts_on_its_own_speed() {
    let cases = [
        ([-1.0, 0.5], [0.0, 0.0], 1),
        ([1.0, 0.5], [0.0, 0.0], 2),
        ([0.5, -1.0], [0.0, 0.0], 3),
        ([0.5, 1.0], [0.0, 0.0], 4),
        ([0.04, -0.04], [0.0, 0.0], 0),
        // It will coast by 0.3 of its velocity: just there; too far; still not far enough in y.
        ([0.3, 0.0], [1.0, 0.0], 0),
        ([0.2, 0.0], [1.0, 0.0], 1),
        ([0.3, 0.1], [1.0, 0.0], 4),
    ];
    for (target, velocity, expected) in cases {
        let seen = observation(&[(BodyKind::Agent, [0.0, 0.0]), (BodyKind::Landmark, target)], velocity);
        assert_eq!(act(Script::NearestAssignment, &seen), [expected], "{target:?} at {velocity:?}");
    }
}

#[test]
fn assigns_by_the_least_total_distance() {
    // Agent 0 is nearest to landmark 0, but so is agent 1, for whom the other is farther still.
    assert_eq!(nearest_assignment(&[[0.0, 0.0], [0.5, 0.0]], &[[0.1, 0.0], [-0.2, 0.0]]), [1, 0]);
    // More landmarks than agents, and fewer.
    let three = [[9.0, 0.0], [0.0, 0.0], [5.0, 0.0]];
    assert_eq!(nearest_assignment(&[[5.0, 1.0]], &three), [2]);
    assert_eq!(nearest_assignment(&three, &[[8.0, 0.0]]), [0]);
    assert_eq!(nearest_assignment(&three, &[]), [0; 0]);

    let mut rng = RunSeed(0).stream(Stream::Environment, 0);
    for n in 1..=5 {
        let mut places = || -> Vec<Vector> {
            let place = |_| [rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)];
            (0..n).map(place).collect()
        };
        let (agents, landmarks) = (places(), places());
        let cost = |assignment: &[usize]| -> f32 {
            let pairs = agents.iter().zip(assignment);
            pairs.map(|(&agent, &landmark)| squared_distance(agent, landmarks[landmark]).sqrt()).sum()
        };
        let least = permutations(n).iter().map(|assignment| cost(assignment)).fold(f32::INFINITY, f32::min);
        let found = cost(&nearest_assignment(&agents, &landmarks));
        assert!((found - least).abs() < 1e-5, "{n}: {found} {least}");
    }
}

fn permutations(n: usize) -> Vec<Vec<usize>> {
    let Some(last) = n.checked_sub(1) else {
        return vec![vec![]];
    };
    let insert = |shorter: Vec<usize>| {
        (0..n).map(move |at| {
            let mut longer = shorter.clone();
            longer.insert(at, last);
            longer
        })
    };
    permutations(last).into_iter().flat_map(insert).collect()
}

#[test]
fn chases_the_one_prey_that_is_nearest_to_any_predator() {
    use BodyKind::{Agent, Landmark, Prey};
    // Predator 0 is nearer to the prey below, but predator 1 nearly has the one at the right.
    let seen = observation(
        &[
            (Agent, [0.0, 0.0]),
            (Agent, [1.8, 0.0]),
            (Landmark, [1.0, 0.0]),
            (Prey, [0.0, -1.0]),
            (Prey, [2.0, 0.0]),
        ],
        [0.0, 0.0],
    );
    assert_eq!(act(Script::Chase, &seen), [2, 2]);
    let nobody = observation(&[(Agent, [0.0, 0.0])], [0.0, 0.0]);
    assert_eq!(act(Script::Chase, &nobody), [0]);
}

#[test]
fn random_takes_available_actions_only() {
    let mut seen = Observation::new(2, 2, 3, 4);
    seen.available_mut(0).copy_from_slice(&[0, 1, 0, 0]);
    seen.available_mut(1).copy_from_slice(&[0, 0, 0, 1]);
    assert_eq!(act(Script::Random, &seen), [1, 3]);
}

#[test]
fn a_script_made_for_other_tasks_says_so() {
    for set in TaskSet::ALL {
        assert_eq!(Script::Random.check(set), Ok(()));
        assert_eq!(Script::Still.check(set), Ok(()));
        let found = [Script::NearestAssignment, Script::Chase].map(|script| script.check(set).is_ok());
        let expected = match set {
            TaskSet::MatrixGame | TaskSet::Combat(_) | TaskSet::Foreign(_) => [false, false],
            TaskSet::CooperativeNavigation => [true, false],
            TaskSet::PredatorPrey | TaskSet::PredatorPreyPro => [false, true],
        };
        assert_eq!(found, expected, "{set}");
    }
    assert_eq!(
        Script::NearestAssignment.check(TaskSet::PredatorPrey).unwrap_err().to_string(),
        "script nearest-assignment is not made for predator-prey; those that are: random, still, chase"
    );
}

#[test]
fn names_lead_back() {
    for script in Script::ALL {
        assert_eq!(script.to_string().parse(), Ok(script));
    }
    assert_eq!(
        "hunt".parse::<Script>().unwrap_err().to_string(),
        "unknown script \"hunt\"; known: random, still, nearest-assignment, chase, nearest, focus, kite"
    );
}
