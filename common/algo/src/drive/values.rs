//! What networks with utilities make of an episode that is over: its task representations, and the values of joint
//! actions, those taken or others in the same states.

use super::td::{Pass, Role, Utilities, ValueNetwork};
use crate::{Model, Rows, model::Network, rows::TerminalStates};
use rit_episode::{Action, Episode};
use rit_nn::{Stock, Tape};

/// Values of an episode of n agents and T steps, agents in decision order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EpisodeValues {
    /// z, `[T, n, h_z]`; empty where a method has none.
    pub representations: Vec<f32>,
    /// Each agent's utility of its action, given those before it, `[T, n]`.
    pub utilities: Vec<f32>,
    /// Q_total of each joint action, `[T]`.
    pub q_total: Vec<f32>,
}

impl Model {
    /// Values the joint actions `[T, n]`, each in the episode's state at that step. The agents' memories are those of the
    /// actions that were really taken. Returns `None` for methods without utilities, and for REFIL and ROMA.
    ///
    /// # Panics
    /// When `params` or `actions` are not as many as there are parameters or actions taken.
    pub fn value(&self, params: &[f32], episode: &Episode, actions: &[Action]) -> Option<EpisodeValues> {
        assert_eq!(actions.len(), episode.actions.len(), "an action for each agent and step");
        match &self.network {
            Network::Recurrent(network) => Some(value(network.as_ref(), params, episode, actions)),
            Network::Updet(network) => Some(value(network.as_ref(), params, episode, actions)),
            Network::Refil(_) | Network::Roma(_) | Network::Mappo(_) | Network::Mat(_) => None,
        }
    }
}

fn value<N: ValueNetwork>(
    network: &N,
    params: &[f32],
    episode: &Episode,
    actions: &[Action],
) -> EpisodeValues {
    let parts = network.parts();
    let mut extended = Vec::new();
    parts.layout.derived().extend(params, &mut extended);
    let tables = network.tables(&extended);
    let rows = Rows::of_episodes(&[episode], TerminalStates::LeftOut);
    let inputs = network.inputs(&rows, &N::Draws::default(), 0);
    // A truncated episode has one more state, in which nothing was done.
    let mut all_actions = actions.to_vec();
    all_actions.resize(rows.agent_rows(), 0);
    let mut tape = Tape::inference(&extended, Stock::default());
    let representation =
        parts.task.as_ref().map(|(task_encoder, _)| task_encoder.forward(&mut tape, &rows, None).1);
    let pass = Pass {
        role: Role::Online,
        rows: &rows,
        tables: &tables,
        representation,
        before: None,
        inputs: &inputs,
    };
    let Utilities { head, .. } = network.forward(&mut tape, pass);
    let mixing = parts.mixer.as_ref().map(|mixer| (mixer, mixer.weights(&mut tape, &rows, representation)));
    let utilities = head.utilities(&mut tape, &rows, &all_actions);
    let chosen = tape.choose(utilities, &all_actions);
    let q_total = match &mixing {
        Some((mixer, weights)) => mixer.mix(&mut tape, &rows.groups, weights, chosen),
        None => tape.sum_over_members(chosen, &rows.groups),
    };
    let taken = actions.len();
    let representations = representation.map_or_else(Vec::new, |representation| {
        tape.slice(representation)[..taken * representation.cols].to_vec()
    });
    EpisodeValues {
        representations,
        utilities: tape.slice(chosen)[..taken].to_vec(),
        q_total: tape.slice(q_total)[..episode.steps()].to_vec(),
    }
}
