//! The encoder that all attention networks share in form, not in parameters (paper, appendix E): every entity is
//! embedded, then each agent attends over entities.

use crate::Rows;
use rit_nn::{Attention, LayoutBuilder, Linear, Tape, Var, attention::Visible};

/// x = ReLU(`embed`(entities)), d → h, and `attention` of the agents over them, a.
#[derive(Clone, Debug)]
pub struct Encoder {
    /// d → h.
    pub embed: Linear,
    /// Of agents over entities, a.
    pub attention: Attention,
}

/// What every entity is, to whoever attends over them. With E entity and R agent rows:
#[derive(Clone, Copy, Debug)]
pub struct Entities {
    /// x, (E, h).
    pub x: Var,
    /// Keys and values, (E, 2a).
    pub key_values: Var,
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
        Self { embed, attention }
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
        let entities = tape.constant(rows.entities());
        let x = tape.linear_relu(&self.embed, entities);
        let key_values = tape.key_values(&self.attention, x);
        Entities { x, key_values }
    }

    /// The agents' queries, (R, a).
    pub fn queries<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows, entities: Entities) -> Var {
        let own = tape.gather(entities.x, &rows.agent_entities);
        let queries = tape.linear(&self.attention.query, own);
        tape.free(own);
        queries
    }

    /// Each agent's attention over the entities it is shown, (R, a).
    pub fn within<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows, visible: Visible<'a>) -> Var {
        let entities = self.entities(tape, rows);
        let queries = self.queries(tape, rows, entities);
        tape.free(entities.x);
        let out = tape.attend(&self.attention, queries, entities.key_values, &rows.groups, visible);
        tape.free(queries);
        tape.free(entities.key_values);
        out
    }

    /// [x_k ‖ each agent's attention over the entities it sees beside itself], (R, h + a): its own features are there
    /// already.
    pub fn beside<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows) -> Var {
        let (h, a) = (self.hidden_dim(), self.attention_dim());
        let entities = self.entities(tape, rows);
        let encoded = tape.reserve(rows.agent_rows(), h + a);
        let (own, attended) = (encoded.columns(0..h), encoded.columns(h..h + a));
        tape.gather_into(entities.x, &rows.agent_entities, own);
        tape.free(entities.x);
        let queries = tape.linear(&self.attention.query, own);
        let masks = [Visible::Where(&rows.others)];
        tape.attend_into(&self.attention, queries, entities.key_values, &rows.groups, &masks, attended);
        tape.free(queries);
        tape.free(entities.key_values);
        encoded
    }
}
