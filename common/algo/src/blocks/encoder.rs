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

    /// Each agent's attention over the entities it is shown under M masks, (R M, a): row `r M + i` is agent row r's under
    /// mask i.
    pub fn within<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows, masks: &[Visible<'a>]) -> Var {
        let entities = self.entities(tape, rows);
        let queries = self.queries(tape, rows, entities);
        tape.free(entities.x);
        let out = tape.reserve(queries.rows * masks.len(), self.attention_dim());
        tape.attend_into(&self.attention, queries, entities.key_values, &rows.groups, masks, out);
        tape.free(queries);
        tape.free(entities.key_values);
        out
    }

    /// [x_k ‖ each agent's attention over the entities it sees beside itself], (R, h + a): its own features are there
    /// already.
    pub fn beside<'a>(&self, tape: &mut Tape<'a>, rows: &'a Rows) -> Var {
        self.beside_under(tape, rows, &rows.agent_entities, &[Visible::Where(&rows.others)])
    }

    /// The same under M masks, none of which shows an agent itself, rows as [`Encoder::within`] has them. `own` are the
    /// entity rows of their agents, `[R M]`.
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
        let queries = if masks.len() == 1 {
            tape.linear(&self.attention.query, x)
        } else {
            self.queries(tape, rows, entities)
        };
        tape.free(entities.x);
        tape.attend_into(&self.attention, queries, entities.key_values, &rows.groups, masks, attended);
        tape.free(queries);
        tape.free(entities.key_values);
        encoded
    }
}
