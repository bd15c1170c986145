//! Inputs of fixed length: the features of all entities in a row, each in its slot (MAPPO and MAT).
//!
//! An agent has the slot of its row; the other entities' slots lie after those of the most agents that any task has.
//! Slots without an entity, and entities unseen, are zeros.

use crate::Rows;
use std::ops::Range;

/// The slots there are: as many as the largest tasks need, those that are only tested on included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slots {
    /// n: slots of agents.
    pub agents_max: usize,
    /// m: all slots.
    pub entities_max: usize,
    /// d.
    pub entity_dim: usize,
}

impl Slots {
    /// Numbers in an input, m d.
    pub fn width(&self) -> usize {
        self.entities_max * self.entity_dim
    }

    /// Writes what each agent sees, `[agent rows, m d]`: its own features, then the other slots in their order. What it
    /// does not see is zeros, be it itself.
    pub fn observations(&self, rows: &Rows, observations: &mut Vec<f32>) {
        observations.clear();
        observations.resize(rows.agent_rows() * self.width(), 0.0);
        let mut inputs = observations.chunks_exact_mut(self.width());
        let mut seen = rows.observable.as_slice();
        for group in &rows.groups {
            let (n_agents, n_entities) = (group.queries.len(), group.keys.len());
            for (agent, input) in (0..n_agents).zip(&mut inputs) {
                let (sees, behind) = seen.split_at(n_entities);
                seen = behind;
                for (entity, &sees) in sees.iter().enumerate() {
                    let place = match self.slot(entity, n_agents) {
                        slot if slot == agent => 0,
                        slot if slot < agent => slot + 1,
                        slot => slot,
                    };
                    if sees != 0 {
                        input[self.features(place)]
                            .copy_from_slice(features(rows, group.keys.start + entity));
                    }
                }
            }
        }
    }

    /// Writes all entities, seen or not, `[groups, m d]`: the slots in their order.
    pub fn states(&self, rows: &Rows, states: &mut Vec<f32>) {
        states.clear();
        states.resize(rows.groups.len() * self.width(), 0.0);
        for (group, state) in rows.groups.iter().zip(states.chunks_exact_mut(self.width())) {
            for (entity, row) in group.keys.clone().enumerate() {
                let slot = self.slot(entity, group.queries.len());
                state[self.features(slot)].copy_from_slice(features(rows, row));
            }
        }
    }

    /// The slot of a group's entity.
    fn slot(&self, entity: usize, n_agents: usize) -> usize {
        if entity < n_agents { entity } else { self.agents_max + entity - n_agents }
    }

    /// Where a slot's features lie.
    fn features(&self, slot: usize) -> Range<usize> {
        slot * self.entity_dim..(slot + 1) * self.entity_dim
    }
}

/// The features of an entity row.
fn features(rows: &Rows, row: usize) -> &[f32] {
    &rows.entities[row * rows.entity_dim..][..rows.entity_dim]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TerminalStates;
    use rit_episode::{End, Episode};

    /// Two agents and another entity of features 1, 2, 3 in one state, 4, 5, 6 in the next, 7, 8, 9 in the last. Agent 1
    /// does not see agent 0 in the second; in the last it sees nothing, itself included.
    fn episode() -> Episode {
        Episode {
            number: 0,
            weights_version: 0,
            task: 0,
            n_agents: 2,
            n_entities: 3,
            decision_order: vec![0, 1],
            entities: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0],
            observable: [[1, 1, 1, 1, 1, 1], [1, 1, 1, 0, 1, 1], [1, 1, 1, 0, 0, 0]].concat(),
            available: vec![1; 6],
            actions: vec![0; 4],
            rewards: vec![0.0; 2],
            shaping: vec![0.0; 2],
            end: End::Truncated,
            won: false,
        }
    }

    #[test]
    fn inputs_by_hand() {
        let rows = Rows::of_episodes(&[&episode()], TerminalStates::LeftOut);
        // Slots: three agents, two others.
        let slots = Slots { agents_max: 3, entities_max: 5, entity_dim: 1 };
        let (mut observations, mut states) = (vec![9.0], vec![9.0]);
        slots.observations(&rows, &mut observations);
        slots.states(&rows, &mut states);
        let expected = [
            [1.0, 2.0, 0.0, 3.0, 0.0],
            [2.0, 1.0, 0.0, 3.0, 0.0],
            [4.0, 5.0, 0.0, 6.0, 0.0],
            [5.0, 0.0, 0.0, 6.0, 0.0],
            [7.0, 8.0, 0.0, 9.0, 0.0],
            [0.0; 5],
        ];
        assert_eq!(observations, expected.as_flattened());
        // The state holds all entities that are there, seen or not.
        let expected = [[1.0, 2.0, 0.0, 3.0, 0.0], [4.0, 5.0, 0.0, 6.0, 0.0], [7.0, 8.0, 0.0, 9.0, 0.0]];
        assert_eq!(states, expected.as_flattened());
    }
}
