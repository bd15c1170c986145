//! What networks with utilities make of an episode that is over: its task representations, and the values of joint
//! actions, those taken or others in the same states.

use super::td::{Pass, Role, Utilities, ValueNetwork};
use crate::{Rows, networks::EpisodeValues, rows::TerminalStates};
use rit_episode::{Action, Episode};
use rit_nn::{Stock, Tape};

/// Values the joint actions `[T, n]` of an episode, see [`Model::value`](crate::Model::value).
pub(super) fn value<N: ValueNetwork>(
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
