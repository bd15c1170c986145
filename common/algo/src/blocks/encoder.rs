//! The encoder that all attention networks share in form, not in parameters (paper, appendix E): every entity is
//! embedded, then each agent attends over entities.

use crate::Rows;
use rit_nn::{Attention, LayoutBuilder, Linear, Tape, Var, attention::Visible, tape::Over};

/// x = ReLU(`embed`(entities)), d → h, and `attention` of the agents over them, a.
///
/// With q = W_q x_k + b_q, a score q · W_k x_j is (W_kᵀ q) · x_j: the product of both weights is a layer of its own,
/// [derived](rit_nn::Derived) once for one set of weights, and entities need no keys. Entities that have not changed since
/// the step before share a row ([`Rows::distinct`]).
#[derive(Clone, Debug)]
pub struct Encoder {
    /// d → h.
    embed: Linear,
    /// Of agents over entities, a.
    attention: Attention,
    /// x_k ↦ W_kᵀ q, head by head: the vector whose dot product with x_j is a score. h → heads · h.
    scores: Linear,
    /// h → a, with ReLU.
    value: Linear,
}

/// The embedding of every distinct entity, shared by all agents that attend over it.
#[derive(Clone, Copy, Debug)]
pub struct Entities {
    /// x, (distinct, h).
    pub x: Var,
    /// (distinct, a).
    pub values: Var,
}

impl Encoder {
    /// Declares `{name}.embed` and `{name}.attention`.
    pub fn new(
        layout: &mut LayoutBuilder,
        name: &str,
        entity_dim: usize,
        hidden_dim: usize,
        attention_dim: usize,
        heads: usize,
    ) -> Self {
        let embed = Linear::new(layout, &format!("{name}.embed"), entity_dim, hidden_dim);
        let attention =
            Attention::new(layout, &format!("{name}.attention"), hidden_dim, attention_dim, heads);
        let scores = layout.derived().scores(&attention);
        let value = attention.value();
        Self { embed, attention, scores, value }
    }

    /// h.
    pub fn hidden_dim(&self) -> usize {
        self.embed.outputs
    }

    /// a.
    pub fn attention_dim(&self) -> usize {
        self.attention.dim
    }

    /// Embeds all entities.
    pub fn entities<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows) -> Entities {
        let entities = tape.constant(rows.distinct());
        let x = tape.linear_relu(&self.embed, entities);
        let values = tape.linear_relu(&self.value, x);
        Entities { x, values }
    }

    /// The agents' queries, (R, heads · h).
    pub fn queries<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows, entities: Entities) -> Var {
        let own = tape.gather(entities.x, &rows.agent_distinct);
        let queries = tape.linear(&self.scores, own);
        tape.free(own);
        queries
    }

    /// Writes what agents see of the entities under M masks into `out` (R M, a): row `r M + i` is agent row r's under
    /// mask i.
    pub fn attend<'a>(
        &self,
        tape: &mut Tape<'a>,
        rows: &'a Rows,
        (queries, entities): (Var, Entities),
        masks: &[Visible<'a>],
        out: Var,
    ) {
        let Entities { x, values } = entities;
        let (heads, head_dim) = (self.attention.heads, self.attention.dim / self.attention.heads);
        let over = Over { queries, keys: x, values, rows: rows.distinct_rows(), heads, head_dim };
        tape.attend_over(over, &rows.groups, masks, out);
    }

    /// Each agent's attention over the entities it is shown under M masks, (R M, a), rows as [`Encoder::attend`] has
    /// them.
    pub fn within<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows, masks: &[Visible<'a>]) -> Var {
        let entities = self.entities(tape, rows);
        let queries = self.queries(tape, rows, entities);
        let out = tape.reserve(queries.rows * masks.len(), self.attention_dim());
        self.attend(tape, rows, (queries, entities), masks, out);
        for var in [queries, entities.x, entities.values] {
            tape.free(var);
        }
        out
    }

    /// [x_k ‖ each agent's attention over the entities it sees beside itself], (R, h + a): its own features are there
    /// already.
    pub fn beside<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows) -> Var {
        self.beside_under(tape, rows, &rows.agent_distinct, &[Visible::Where(&rows.others)])
    }

    /// The same under M masks, none of which shows an agent itself, rows as [`Encoder::attend`] has them. `own` are the
    /// distinct entities that their agents are, `[R M]`.
    pub fn beside_under<'a>(
        &self,
        tape: &mut Tape<'a>,
        rows: &'a Rows,
        own: &'a [usize],
        masks: &[Visible<'a>],
    ) -> Var {
        let (h, a) = (self.hidden_dim(), self.attention_dim());
        let entities = self.entities(tape, rows);
        let encoded = tape.reserve(own.len(), h + a);
        let (x, attended) = (encoded.columns(0..h), encoded.columns(h..h + a));
        tape.gather_into(entities.x, own, x);
        let queries =
            if masks.len() == 1 { tape.linear(&self.scores, x) } else { self.queries(tape, rows, entities) };
        self.attend(tape, rows, (queries, entities), masks, attended);
        for var in [queries, entities.x, entities.values] {
            tape.free(var);
        }
        encoded
    }
}

#[cfg(test)]
mod tests;
