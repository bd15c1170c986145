//! The rows of a batch that exist, in the order the networks work on them.
//!
//! Padding never reaches the networks. Episodes of a batch are ordered longest first and laid out time-major:
//! all rows of time 0, then of time 1, …. Time T of an episode is its bootstrap state, which is there only where a
//! target needs it. So the rows of a time are a prefix of those of the time before, and one product serves all
//! times where nothing is recurrent.

use rit_episode::{End, Episode, Turn};
use rit_nn::{View, attention::Group};

/// One (episode, time) of a batch: a group of agents that decide together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Index of the episode in the batch.
    pub episode: usize,
    /// Decision step, 0 to T; T is the bootstrap state, where nothing is decided.
    pub time: usize,
    /// What the step pays in training, team reward and shaping; 0 in the bootstrap state.
    pub reward: f32,
    /// Whether the step was taken: false in the bootstrap state.
    pub filled: bool,
    /// Whether it was the last of an episode that terminated: its target does not bootstrap.
    pub terminated: bool,
    /// Index of the episode's task.
    pub task: usize,
}

/// The packed rows of a batch, or of several running episodes at one step.
///
/// *Groups* are (time, episode) pairs; *agent rows* are the groups' agents in decision order, one group after
/// another; *entity rows* are the groups' entities, agents first.
#[derive(Debug, Default)]
pub struct Rows {
    /// Each group's agent rows (queries) and entity rows (keys).
    pub groups: Vec<Group>,
    /// What happened in each group.
    pub steps: Vec<Step>,
    /// First agent row of each time, then the number of agent rows.
    pub agent_times: Vec<usize>,
    /// First group of each time, then the number of groups.
    pub group_times: Vec<usize>,
    /// Features, `[entity rows, d]`.
    pub entities: Vec<f32>,
    /// The entity row of each agent row.
    pub agent_entities: Vec<usize>,
    /// Features of distinct entities, `[distinct, d]`: one that has not changed since the step before has no other row.
    distinct: Vec<f32>,
    /// The distinct row of each entity row.
    distinct_of: Vec<usize>,
    /// The distinct row of each agent row.
    pub agent_distinct: Vec<usize>,
    /// Which of the group's entities each agent sees: the groups' `[n, m]` one after another.
    pub observable: Vec<u8>,
    /// The same with each agent itself left out.
    pub others: Vec<u8>,
    /// Which actions each agent may take, `[agent rows, A]`.
    pub available: Vec<u8>,
    /// Actions taken, `[agent rows]`; 0 in bootstrap states.
    pub actions: Vec<u8>,
    /// Team reward of the step before, 0 at the first, `[groups]`.
    pub previous_rewards: Vec<f32>,
    /// Features of one entity, d.
    pub entity_dim: usize,
    /// Each episode's place in every time it reaches, by its index in the batch.
    places: Vec<usize>,
}

/// What becomes of the states after the last step of episodes that terminated: no target needs them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TerminalStates {
    /// They get no rows.
    #[default]
    LeftOut,
    /// They get rows like any other: for comparison with implementations that work on them.
    Kept,
}

impl Rows {
    /// Lays out a batch of episodes.
    pub fn of_episodes(episodes: &[&Episode], terminal: TerminalStates) -> Self {
        let mut rows = Self::default();
        rows.fill_from_episodes(episodes, terminal);
        rows
    }

    /// Lays out a batch of episodes, keeping memory.
    pub fn fill_from_episodes(&mut self, episodes: &[&Episode], terminal: TerminalStates) {
        self.clear();
        let states = |index: usize| {
            let left_out = terminal == TerminalStates::LeftOut && episodes[index].end == End::Terminated;
            episodes[index].steps() + usize::from(!left_out)
        };
        // A stable order: equal lengths keep the batch's order.
        let mut order: Vec<usize> = (0..episodes.len()).collect();
        order.sort_by_key(|&index| std::cmp::Reverse(states(index)));
        self.places.resize(episodes.len(), 0);
        for (place, &index) in order.iter().enumerate() {
            self.places[index] = place;
        }
        let longest = order.first().map_or(0, |&index| states(index));
        for time in 0..longest {
            self.begin_time();
            for &index in order.iter().take_while(|&&index| states(index) > time) {
                self.push_episode_step(index, time, episodes[index]);
            }
        }
        self.begin_time();
    }

    /// Lays out the present step of several running episodes: one time, actions unknown.
    pub fn fill_from_turns(&mut self, turns: &[Turn<'_>]) {
        self.clear();
        self.begin_time();
        for (index, turn) in turns.iter().enumerate() {
            let seen = turn.observation;
            let step =
                Step { episode: index, time: 0, reward: 0.0, filled: false, terminated: false, task: 0 };
            self.push_group(seen.n_agents(), seen.n_entities(), step, turn.previous_reward);
            self.push_state(seen.n_agents(), seen.n_entities(), seen.entities(), seen.observable(), None);
            self.available.extend_from_slice(seen.available());
            self.places.push(index);
        }
        self.actions.resize(self.agent_rows(), 0);
        self.begin_time();
    }

    /// Number of agent rows.
    pub fn agent_rows(&self) -> usize {
        self.groups.last().map_or(0, |group| group.queries.end)
    }

    /// Number of entity rows.
    pub fn entity_rows(&self) -> usize {
        self.groups.last().map_or(0, |group| group.keys.end)
    }

    /// Features, (entity rows, d).
    pub fn entities(&self) -> View<'_> {
        View {
            data: &self.entities,
            rows: self.entity_rows(),
            cols: self.entity_dim,
            stride: self.entity_dim,
        }
    }

    /// Features of distinct entities, (distinct, d).
    pub fn distinct(&self) -> View<'_> {
        let d = self.entity_dim;
        View { data: &self.distinct, rows: self.distinct.len() / d.max(1), cols: d, stride: d }
    }

    /// The distinct row of each entity row; `None` where each has its own, in the same order.
    pub fn distinct_rows(&self) -> Option<&[usize]> {
        (self.distinct.len() < self.entities.len()).then_some(&self.distinct_of)
    }

    /// The group of an episode, by its index in the batch, at a time it reaches.
    pub fn group_of(&self, episode: usize, time: usize) -> usize {
        self.group_times[time] + self.places[episode]
    }

    /// The group of the same episode one step later, where it has one.
    pub fn next_group(&self, group: usize) -> Option<usize> {
        let Step { episode, time, .. } = self.steps[group];
        let next = self.group_times.get(time + 1)? + self.places[episode];
        let is_there = next < *self.group_times.get(time + 2)?;
        is_there.then_some(next)
    }

    /// The filled agent rows in the order (episode of the batch, time, agent): the order in which the
    /// contrastive loss pairs them.
    pub fn filled_agent_rows(&self) -> impl Iterator<Item = (usize, &Step)> {
        (0..self.places.len()).flat_map(move |episode| {
            let groups = (0..self.group_times.len() - 1)
                .take_while(move |&time| {
                    self.group_times[time] + self.places[episode] < self.group_times[time + 1]
                })
                .map(move |time| self.group_of(episode, time));
            groups.filter(|&group| self.steps[group].filled).flat_map(move |group| {
                self.groups[group].queries.clone().map(move |row| (row, &self.steps[group]))
            })
        })
    }

    fn clear(&mut self) {
        self.groups.clear();
        self.steps.clear();
        self.agent_times.clear();
        self.group_times.clear();
        self.entities.clear();
        self.agent_entities.clear();
        self.distinct.clear();
        self.distinct_of.clear();
        self.agent_distinct.clear();
        self.observable.clear();
        self.others.clear();
        self.available.clear();
        self.actions.clear();
        self.previous_rewards.clear();
        self.places.clear();
    }

    fn begin_time(&mut self) {
        self.agent_times.push(self.agent_rows());
        self.group_times.push(self.groups.len());
    }

    fn push_episode_step(&mut self, index: usize, time: usize, episode: &Episode) {
        let (n, m, steps) = (episode.n_agents, episode.n_entities, episode.steps());
        let filled = time < steps;
        let terminated = time + 1 == steps && episode.end == End::Terminated;
        let reward = if filled { episode.rewards[time] + episode.shaping[time] } else { 0.0 };
        let step = Step { episode: index, time, reward, filled, terminated, task: episode.task };
        let d = episode.entities.len() / ((steps + 1) * m);
        let n_actions = episode.available.len() / ((steps + 1) * n);
        let part = |width: usize| time * width..(time + 1) * width;
        self.push_group(n, m, step, if time == 0 { 0.0 } else { episode.rewards[time - 1] });
        let before = (time > 0).then(|| self.groups[self.group_of(index, time - 1)].keys.start);
        self.push_state(n, m, &episode.entities[part(m * d)], &episode.observable[part(n * m)], before);
        self.available.extend_from_slice(&episode.available[part(n * n_actions)]);
        if filled {
            self.actions.extend_from_slice(&episode.actions[part(n)]);
        } else {
            self.actions.resize(self.actions.len() + n, 0);
        }
    }

    fn push_group(&mut self, n_agents: usize, n_entities: usize, step: Step, previous_reward: f32) {
        let (agents, entities) = (self.agent_rows(), self.entity_rows());
        self.agent_entities.extend(entities..entities + n_agents);
        self.groups.push(Group { queries: agents..agents + n_agents, keys: entities..entities + n_entities });
        self.steps.push(step);
        self.previous_rewards.push(previous_reward);
    }

    /// `before` is the first entity row of the same episode's step before.
    fn push_state(
        &mut self,
        n_agents: usize,
        n_entities: usize,
        entities: &[f32],
        observable: &[u8],
        before: Option<usize>,
    ) {
        let d = entities.len() / n_entities;
        self.entity_dim = d;
        let first = self.distinct_of.len();
        for (row, features) in entities.chunks_exact(d).enumerate() {
            let unchanged = before.map(|before| before + row).filter(|&row| {
                let last = &self.entities[row * d..(row + 1) * d];
                // Bit by bit: what is no number is not equal to itself.
                last.iter().zip(features).all(|(a, b)| a.to_bits() == b.to_bits())
            });
            let distinct = unchanged.map_or(self.distinct.len() / d, |row| self.distinct_of[row]);
            if unchanged.is_none() {
                self.distinct.extend_from_slice(features);
            }
            self.distinct_of.push(distinct);
        }
        self.agent_distinct.extend_from_slice(&self.distinct_of[first..first + n_agents]);
        self.entities.extend_from_slice(entities);
        self.observable.extend_from_slice(observable);
        let first = self.others.len();
        self.others.extend_from_slice(observable);
        for agent in 0..n_agents {
            self.others[first + agent * n_entities + agent] = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An episode whose every number says where it belongs: entity feature = 100 · task + 10 · time + row.
    fn episode(task: usize, n: usize, m: usize, steps: usize, end: End) -> Episode {
        let rows = (0..=steps).flat_map(|time| (0..m).map(move |row| (100 * task + 10 * time + row) as f32));
        Episode {
            number: 0,
            weights_version: 0,
            task,
            n_agents: n,
            n_entities: m,
            decision_order: rit_episode::decision_order::identity(n),
            entities: rows.collect(),
            observable: vec![1; (steps + 1) * n * m],
            available: vec![1; (steps + 1) * n * 2],
            actions: (0..steps * n).map(|row| (row % 2) as u8).collect(),
            rewards: (0..steps).map(|time| time as f32 + 1.0).collect(),
            shaping: vec![0.25; steps],
            end,
            won: false,
        }
    }

    #[test]
    fn rows_lie_time_major_longest_first() {
        let short = episode(1, 1, 2, 1, End::Truncated);
        let long = episode(2, 2, 3, 2, End::Terminated);
        let rows = Rows::of_episodes(&[&short, &long], TerminalStates::Kept);
        // Time 0: long, short; time 1: long, short's bootstrap; time 2: long's bootstrap.
        assert_eq!(rows.group_times, [0, 2, 4, 5]);
        assert_eq!(rows.agent_times, [0, 3, 6, 8]);
        let whose: Vec<_> = rows.steps.iter().map(|step| (step.episode, step.time)).collect();
        assert_eq!(whose, [(1, 0), (0, 0), (1, 1), (0, 1), (1, 2)]);
        let facts: Vec<_> = rows.steps.iter().map(|s| (s.filled, s.terminated, s.reward)).collect();
        // What training adds is part of what a step pays, but not of what the task encoder is shown.
        let expected = [
            (true, false, 1.25),
            (true, false, 1.25),
            (true, true, 2.25),
            (false, false, 0.0),
            (false, false, 0.0),
        ];
        assert_eq!(facts, expected);
        let entities = [200, 201, 202, 100, 101, 210, 211, 212, 110, 111, 220, 221, 222];
        assert_eq!(rows.entities, entities.map(|x| x as f32));
        assert_eq!(rows.previous_rewards, [0.0, 0.0, 1.0, 1.0, 2.0]);
        assert_eq!(rows.others[..8], [0, 1, 1, 1, 0, 1, 0, 1]);
        assert_eq!(rows.observable, [1; 22]);
        assert_eq!(rows.agent_entities, [0, 1, 3, 5, 6, 8, 10, 11]);
        assert_eq!((rows.distinct_rows(), &rows.agent_distinct), (None, &rows.agent_entities));
        let next: Vec<_> = (0..5).map(|group| rows.next_group(group)).collect();
        assert_eq!(next, [Some(2), Some(3), Some(4), None, None]);
        // The contrastive order is the batch's: short's one row, then long's four.
        let ordered: Vec<_> = rows.filled_agent_rows().map(|(row, step)| (row, step.task)).collect();
        assert_eq!(ordered, [(2, 1), (0, 2), (1, 2), (3, 2), (4, 2)]);
    }

    #[test]
    fn entities_that_do_not_change_share_a_row() {
        let mut moving = episode(1, 1, 3, 3, End::Truncated);
        // Of three entities over four states, the second never moves, the third in the third state only.
        moving.entities = [[1.0, 5.0, 7.0], [2.0, 5.0, 7.0], [3.0, 5.0, 8.0], [4.0, 5.0, 8.0]].concat();
        let still = Episode { entities: vec![1.0, 1.0], ..episode(2, 1, 1, 1, End::Truncated) };
        let rows = Rows::of_episodes(&[&moving, &still], TerminalStates::Kept);
        // Times: (moving, still), (moving, still), moving, moving.
        assert_eq!(rows.distinct().data, [1.0, 5.0, 7.0, 1.0, 2.0, 3.0, 8.0, 4.0]);
        let expected = [0, 1, 2, 3, 4, 1, 2, 3, 5, 1, 6, 7, 1, 6];
        assert_eq!(rows.distinct_rows(), Some(&expected[..]));
        assert_eq!(rows.agent_distinct, [0, 3, 4, 3, 5, 7]);
        let shown: Vec<f32> = expected.iter().map(|&row| rows.distinct().data[row]).collect();
        assert_eq!(shown, rows.entities);
    }

    #[test]
    fn states_that_no_target_needs_are_left_out() {
        let terminated = episode(1, 1, 2, 2, End::Terminated);
        let truncated = episode(2, 2, 3, 1, End::Truncated);
        let rows = Rows::of_episodes(&[&terminated, &truncated], TerminalStates::LeftOut);
        let whose: Vec<_> = rows.steps.iter().map(|step| (step.episode, step.time, step.filled)).collect();
        assert_eq!(whose, [(0, 0, true), (1, 0, true), (0, 1, true), (1, 1, false)]);
        let next: Vec<_> = (0..4).map(|group| rows.next_group(group)).collect();
        assert_eq!(next, [Some(2), Some(3), None, None]);
        assert_eq!((rows.agent_rows(), rows.entity_rows()), (6, 10));
    }
}
