//! A trained policy acts as evaluation acts, to the last bit, whatever other episodes it acts in at the same time.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests too")]

use rit_algo::{Acting, Method, Model};
use rit_config::Config;
use rit_env::{
    Embedded, Split,
    rollout::{Job, Rollout, all_rolled},
};
use rit_episode::{Choice, Episode, Observation, Policy, RunSeed, Stream, Turn};
use rit_policy::{ActError, Description, State, TaskNames, TrainedPolicy, Weights};
use std::sync::Arc;

const STEPS_LEFT_OUT: usize = 2;

fn config(method: Method) -> Config {
    let text = "environment.task_set = \"predator-prey\"\nnetwork.hidden_dim = 8";
    let name = format!("algorithm.name={method}");
    rit_config::resolve(text, "test", &[rit_config::set(&name).unwrap()]).unwrap()
}

fn weights(config: &Config) -> Weights {
    let model = Model::new(config.model()).unwrap();
    let params = model.initial(&mut RunSeed(5).stream(Stream::Weights, 0));
    let description = Description::new(model.config(), &TaskNames::of(config), String::new());
    Weights { description, model: Arc::new(model), params }
}

/// Acts, and keeps what its actions were chosen by.
struct Watched {
    acting: Acting,
    utilities: Vec<Vec<f32>>,
    representations: Vec<Vec<f32>>,
}

impl Policy for Watched {
    fn begin(&mut self, slot: usize, n_agents: usize) {
        self.acting.begin(slot, n_agents);
    }

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        self.acting.act(turns);
        self.utilities.push(self.acting.utilities().to_vec());
        self.representations.push(self.acting.task_representations().to_vec());
    }
}

/// A greedy episode of a task, with what its actions were chosen by.
fn rolled(config: &Config, weights: &Weights, task: usize, number: u64) -> (Episode, Watched) {
    let acting = Acting::new(&weights.model, &weights.params[weights.model.acting()]);
    let mut watched = Watched { acting, utilities: Vec::new(), representations: Vec::new() };
    let job = Job { number, weights_version: 0, choice: Choice::Greedy, task: Some(task) };
    let worlds = Arc::new(Embedded(config.environment_options()));
    let mut rollout = Rollout::new(config.tasks(Split::Training), worlds, RunSeed(9), true);
    let episode = all_rolled(rollout.roll(&mut watched, &[job])).unwrap().remove(0);
    (episode, watched)
}

/// What the agents of an episode saw at a step, in their own order and without last actions.
fn seen(episode: &Episode, step: usize, features: usize, n_actions: usize) -> Observation {
    let (n, m, d) = (episode.n_agents, episode.n_entities, features + n_actions);
    let own = |row: usize| episode.decision_order.get(row).map_or(row, |&agent| usize::from(agent));
    let mut seen = Observation::new(n, m, features, n_actions);
    for row in 0..m {
        let from = &episode.entities[(step * m + row) * d..][..features];
        seen.entity_mut(own(row)).copy_from_slice(from);
    }
    for row in 0..n {
        for column in 0..m {
            seen.observable_mut(own(row))[own(column)] = episode.observable[(step * n + row) * m + column];
        }
        let available = &episode.available[(step * n + row) * n_actions..][..n_actions];
        seen.available_mut(own(row)).copy_from_slice(available);
    }
    seen
}

/// Rows of decision order in the agents' own.
fn own_order(order: &[u8], rows: &[f32]) -> Vec<u32> {
    let width = rows.len() / order.len();
    let mut own = vec![0; rows.len()];
    for (row, &agent) in order.iter().enumerate() {
        for column in 0..width {
            own[usize::from(agent) * width + column] = rows[row * width + column].to_bits();
        }
    }
    own
}

#[test]
fn every_method_acts_as_evaluation_does_with_any_episodes_beside() {
    for method in Method::ALL {
        let config = config(method);
        let weights = weights(&config);
        let episodes: Vec<_> = (0..3).map(|task| rolled(&config, &weights, task, 10 + task as u64)).collect();
        let mut policy = TrainedPolicy::new(weights);
        let (features, n_actions) = (policy.feature_dim(), policy.n_actions());
        assert_eq!((features, n_actions), (7, 5));
        for (slot, (episode, _)) in episodes.iter().enumerate() {
            policy.begin(slot, episode.n_agents, Some(episode.decision_order.clone())).unwrap();
        }
        for step in 0..episodes[0].0.steps() {
            // The last is over two steps before the others.
            let going_on = |slot: usize| slot < 2 || step + STEPS_LEFT_OUT < episodes[0].0.steps();
            let slots: Vec<_> = (0..3).filter(|&slot| going_on(slot)).rev().collect();
            let observations: Vec<_> =
                slots.iter().map(|&slot| seen(&episodes[slot].0, step, features, n_actions)).collect();
            let states = slots.iter().zip(&observations).map(|(&episode, observation)| State {
                episode,
                observation,
                previous_reward: if step == 0 { 0.0 } else { episodes[episode].0.rewards[step - 1] },
            });
            policy.act(&states.collect::<Vec<_>>()).unwrap();
            for slot in slots {
                let (episode, watched) = &episodes[slot];
                let n = episode.n_agents;
                let chosen = &episode.actions[step * n..][..n];
                let places =
                    episode.decision_order.iter().map(|&agent| policy.actions(slot)[usize::from(agent)]);
                assert_eq!(places.collect::<Vec<_>>(), chosen, "{method}, step {step}");
                let bits = |numbers: &[f32]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                let order = &episode.decision_order;
                assert_eq!(bits(policy.utilities(slot)), own_order(order, &watched.utilities[step]));
                assert_eq!(
                    bits(policy.task_representations(slot)),
                    own_order(order, &watched.representations[step])
                );
                assert_eq!(policy.task_representations(slot).len(), n * policy.representation_dim());
            }
        }
    }
}

#[test]
fn what_it_cannot_act_in_is_named_and_changes_nothing() {
    let config = config(Method::Mappo);
    let mut policy = TrainedPolicy::new(weights(&config));
    let mut good = Observation::new(2, 3, 7, 5);
    good.see_and_allow_all();
    let act = |policy: &mut TrainedPolicy, episode, observation: &Observation, previous_reward| {
        policy.act(&[State { episode, observation, previous_reward }]).map_err(|error| error.to_string())
    };
    assert_eq!(
        act(&mut policy, 0, &good, 0.0).unwrap_err(),
        "episode 0 has not begun; begin it with its number of agents first"
    );
    assert_eq!(
        policy.begin(0, 9, None).unwrap_err().to_string(),
        "episode 0: 9 agents; this policy takes 1 to 5"
    );
    assert_eq!(
        policy.begin(0, 0, None),
        Err(ActError::Count { episode: 0, what: "agents", found: 0, min: 1, max: 5 })
    );
    assert_eq!(
        policy.begin(0, 2, Some(vec![0, 0])).unwrap_err().to_string(),
        "episode 0: the decision order must have each of 0 to 1 once"
    );
    policy.begin(1, 2, None).unwrap();
    assert!(act(&mut policy, 0, &good, 0.0).unwrap_err().contains("episode 0 has not begun"));
    assert!(act(&mut policy, 7, &good, 0.0).unwrap_err().contains("episode 7 has not begun"));
    let mut refused =
        |observation: &Observation, reward| act(&mut policy, 1, observation, reward).unwrap_err();
    assert_eq!(refused(&Observation::new(3, 3, 7, 5), 0.0), "episode 1: 3 agents, not 2");
    assert_eq!(refused(&Observation::new(2, 3, 6, 5), 0.0), "episode 1: 6 features of an entity, not 7");
    assert_eq!(refused(&Observation::new(2, 3, 7, 4), 0.0), "episode 1: 4 actions, not 5");
    assert_eq!(
        refused(&Observation::new(2, 9, 7, 5), 0.0),
        "episode 1: 7 entities that are no agents; this policy takes 0 to 4"
    );
    assert!(refused(&Observation::new(2, 3, 7, 5), 0.0).contains("agent 0 has no available action"));
    assert!(refused(&good, f32::NAN).contains("previous_reward is NaN; it must be a finite number"));
    assert!(policy.actions(1).is_empty());
    let state = State { episode: 1, observation: &good, previous_reward: 0.0 };
    assert_eq!(policy.act(&[state, state]), Err(ActError::Twice { episode: 1 }));
    policy.act(&[state]).unwrap();
    assert_eq!((policy.actions(1).len(), policy.utilities(1).len()), (2, 10));
}
