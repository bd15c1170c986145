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

    // As many agents as landmarks, fewer and more: the least of all that there are.
    let mut rng = RunSeed(0).stream(Stream::Environment, 0);
    for (n, m) in (1..=5).flat_map(|n| (1..=5).map(move |m| (n, m))) {
        let (agents, landmarks) = (places(n, &mut rng), places(m, &mut rng));
        let placed = n.min(m);
        let cost = |assignment: &[usize]| -> f32 {
            let pairs = agents.iter().zip(assignment);
            pairs.map(|(&agent, &landmark)| squared_distance(agent, landmarks[landmark]).sqrt()).sum()
        };
        let all = permutations(m);
        let least = all.iter().map(|all| cost(&all[..placed])).fold(f32::INFINITY, f32::min);
        let assignment = nearest_assignment(&agents, &landmarks);
        assert_eq!(assignment.len(), placed, "{n} agents, {m} landmarks");
        let mut taken = assignment.clone();
        taken.sort_unstable();
        taken.dedup();
        assert_eq!(taken.len(), placed, "{n} agents, {m} landmarks: {assignment:?}");
        let found = cost(&assignment);
        assert!((found - least).abs() < 1e-5, "{n} agents, {m} landmarks: {found} {least}");
    }
}

fn places(n: usize, rng: &mut rit_episode::Rng) -> Vec<Vector> {
    (0..n).map(|_| [rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)]).collect()
}

/// The largest tasks that have a name: sets of landmarks can no longer be listed, but what is least is known.
#[test]
fn assigns_as_many_as_a_task_may_have() {
    let mut rng = RunSeed(1).stream(Stream::Environment, 0);
    let agents = places(64, &mut rng);
    // Landmarks where the agents are, in another order.
    let elsewhere: Vec<usize> = (0..64).map(|agent| (agent * 23 + 5) % 64).collect();
    let mut landmarks = vec![[0.0; 2]; 64];
    for (&place, &landmark) in agents.iter().zip(&elsewhere) {
        landmarks[landmark] = place;
    }
    assert_eq!(nearest_assignment(&agents, &landmarks), elsewhere);
    // On a line the first goes to the first, the second to the second, and so on.
    let on_a_line =
        |places: Vec<Vector>| -> Vec<Vector> { places.into_iter().map(|[x, _]| [x, 0.0]).collect() };
    let (agents, landmarks) = (on_a_line(places(64, &mut rng)), on_a_line(places(64, &mut rng)));
    let sorted = |places: &[Vector]| {
        let mut sorted: Vec<f32> = places.iter().map(|place| place[0]).collect();
        sorted.sort_by(f32::total_cmp);
        sorted
    };
    let pairs = sorted(&agents).into_iter().zip(sorted(&landmarks));
    let least: f32 = pairs.map(|(agent, landmark)| (agent - landmark).abs()).sum();
    let assignment = nearest_assignment(&agents, &landmarks);
    let pairs = agents.iter().zip(assignment);
    let found: f32 = pairs.map(|(agent, landmark)| (agent[0] - landmarks[landmark][0]).abs()).sum();
    assert!((found - least).abs() < 1e-4, "{found} {least}");
    // And one step of the script in such a task.
    let task = TaskSet::CooperativeNavigation.task("navigation-40-40").unwrap();
    let mut world = task.environment(crate::EnvironmentOptions::default());
    world.reset(&mut rng).unwrap();
    let spec = world.spec();
    let mut seen = Observation::new(spec.n_agents, spec.n_entities, spec.feature_dim, spec.n_actions);
    world.observe(&mut seen);
    let actions = act(Script::NearestAssignment, &seen);
    assert!(actions.len() == 40 && actions.iter().any(|&action| action != 0));
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
    let without_prey = observation(&[(Agent, [0.0, 0.0])], [0.0, 0.0]);
    assert_eq!(act(Script::Chase, &without_prey), [0]);
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
