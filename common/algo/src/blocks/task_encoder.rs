//! The task representation function f^ω: z^k from each agent's observations, actions and the rewards of the
//! steps before (paper, section IV-B and figure 1 b).

use super::Encoder;
use crate::Rows;
use rit_nn::{Gru, LayoutBuilder, Linear, Tape, Var, View};

/// The task representation function.
#[derive(Clone, Debug)]
pub struct TaskEncoder {
    encoder: Encoder,
    /// 1 → r.
    reward_embed: Linear,
    /// Over [x_k ‖ attention ‖ reward].
    gru: Gru,
    /// h → h_z.
    out: Linear,
}

impl TaskEncoder {
    /// Declares all parameters named `task_encoder.…` but those of `encoder`, which is declared.
    pub fn new(layout: &mut LayoutBuilder, encoder: Encoder, reward_embed_dim: usize, dim: usize) -> Self {
        let (h, a) = (encoder.hidden_dim(), encoder.attention_dim());
        let reward_embed = Linear::new(layout, "task_encoder.reward_embed", 1, reward_embed_dim);
        let gru = Gru::new(layout, "task_encoder.gru", h + a + reward_embed_dim, h);
        let out = Linear::new(layout, "task_encoder.out", h, dim);
        Self { encoder, reward_embed, gru, out }
    }

    /// h_z.
    pub fn dim(&self) -> usize {
        self.out.outputs
    }

    /// h: numbers that an agent remembers.
    pub fn memory_dim(&self) -> usize {
        self.gru.hidden_dim
    }

    /// The GRU's states (R, h) and z (R, h_z) of all rows. `before` (rows of the first time, h) is the GRU's state
    /// before the first time, or zeros.
    pub fn forward<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows, before: Option<Var>) -> (Var, Var) {
        let encoded = self.encoder.beside(tape, rows);
        let gates = tape.product_of(&self.gru.input, 0, &[encoded]);
        tape.free(encoded);
        // The reward is the team's, so it is embedded once per group.
        let rewards = tape.constant(View::dense(&rows.previous_rewards, 1));
        let rewards = tape.linear_relu(&self.reward_embed, rewards);
        let of_groups = tape.product_of(&self.gru.input, encoded.cols, &[rewards]);
        tape.free(rewards);
        tape.add_to_members(gates, of_groups, &rows.groups);
        tape.free(of_groups);
        let history = tape.gru(&self.gru, gates, &rows.agent_times, before);
        let representation = tape.linear(&self.out, history);
        (history, representation)
    }
}

#[cfg(test)]
mod tests;
