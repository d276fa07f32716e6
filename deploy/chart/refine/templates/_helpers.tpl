{{- define "refine.name" -}}
{{ .Release.Name | trunc 40 | trimSuffix "-" }}
{{- end }}

{{- define "refine.selector" -}}
app.kubernetes.io/name: refine
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
{{- end }}

{{- define "refine.labels" -}}
{{ include "refine.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ .root.Chart.Name }}-{{ .root.Chart.Version }}
{{- end }}

{{- define "refine.tag" -}}
{{ .Values.tag | default .Chart.AppVersion }}
{{- end }}

{{- define "refine.redisHost" -}}
{{- if .Values.redis.inChart }}{{ include "refine.name" . }}-redis{{ else }}{{ required "expected redis.host with redis.inChart=false" .Values.redis.host }}{{ end }}
{{- end }}

{{- define "refine.tls" -}}
{{- if and .Values.redis.tls.enabled (not .Values.redis.inChart) }}true{{ end }}
{{- end }}

{{- define "refine.stopGrace" -}}
{{ .Values.worker.stopGraceSeconds | default .Values.jobs.timeoutSeconds | int }}
{{- end }}

{{/* What service and worker must agree on. */}}
{{- define "refine.environment" -}}
{{- with .Values.redis.passwordSecret }}{{ if .name }}
- name: REDIS_PASSWORD
  valueFrom: {secretKeyRef: {name: {{ .name }}, key: {{ .key }}}}
{{- end }}{{ end }}
{{- $account := "" }}
{{- if .Values.redis.passwordSecret.name }}{{ $account = printf "%s:$(REDIS_PASSWORD)@" .Values.redis.username }}{{ end }}
- name: REFINE_REDIS_URL
  value: {{ printf "redis%s://%s%s:%d/%d%s" (ternary "s" "" (eq (include "refine.tls" .) "true")) $account (include "refine.redisHost" .) (int .Values.redis.port) (int .Values.redis.database) (ternary "?ssl_ca_certs=/etc/refine/redis/ca.crt" "" (and (eq (include "refine.tls" .) "true") (ne .Values.redis.tls.caSecret ""))) | quote }}
- {name: REFINE_POOL, value: {{ .Values.jobs.pool | quote }}}
- {name: REFINE_DATA_FOLDER, value: /var/lib/refine}
- {name: REFINE_JOB_TIMEOUT_S, value: {{ int .Values.jobs.timeoutSeconds | quote }}}
- {name: REFINE_RETENTION_S, value: {{ int .Values.jobs.retentionSeconds | quote }}}
- {name: REFINE_MAX_QUEUED, value: {{ int .Values.jobs.maxQueued | quote }}}
{{- with .Values.blobs.s3 }}{{ if .url }}
- {name: REFINE_BLOB_URL, value: {{ .url | quote }}}
- {name: AWS_REGION, value: {{ .region | quote }}}
{{- if .endpoint }}
- {name: AWS_ENDPOINT_URL, value: {{ .endpoint | quote }}}
{{- end }}
{{- if .allowHttp }}
- {name: AWS_ALLOW_HTTP, value: "true"}
{{- end }}
{{- end }}{{ end }}
{{- end }}

{{- define "refine.environmentFrom" -}}
{{- if and .Values.blobs.s3.url .Values.blobs.s3.secret }}
envFrom: [{secretRef: {name: {{ .Values.blobs.s3.secret }}}}]
{{- end }}
{{- end }}

{{- define "refine.mounts" -}}
- {name: tmp, mountPath: /tmp}
{{- if not .Values.blobs.s3.url }}
- {name: blobs, mountPath: /var/lib/refine/blobs}
{{- end }}
{{- if and (include "refine.tls" .) .Values.redis.tls.caSecret }}
- {name: redis-ca, mountPath: /etc/refine/redis, readOnly: true}
{{- end }}
{{- end }}

{{- define "refine.volumes" -}}
{{- if not .Values.blobs.s3.url }}
- name: blobs
  persistentVolumeClaim: {claimName: {{ .Values.blobs.volume.existingClaim | default (printf "%s-blobs" (include "refine.name" .)) }}}
{{- end }}
{{- if and (include "refine.tls" .) .Values.redis.tls.caSecret }}
- name: redis-ca
  secret: {secretName: {{ .Values.redis.tls.caSecret }}}
{{- end }}
{{- end }}

{{- define "refine.podSecurity" -}}
securityContext:
  runAsNonRoot: true
  runAsUser: {{ .uid }}
  runAsGroup: {{ .uid }}
  fsGroup: {{ .uid }}
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile: {type: RuntimeDefault}
{{- end }}

{{- define "refine.security" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: {drop: [ALL]}
{{- end }}

{{- define "refine.common" -}}
{{- with .root.Values.imagePullSecrets }}
imagePullSecrets:
{{- range . }}
  - name: {{ . }}
{{- end }}
{{- end }}
serviceAccountName: {{ if .root.Values.serviceAccount.create }}{{ include "refine.name" .root }}{{ else }}default{{ end }}
automountServiceAccountToken: false
{{- with .part.nodeSelector }}
nodeSelector: {{ toJson . }}
{{- end }}
{{- with .part.tolerations }}
tolerations: {{ toJson . }}
{{- end }}
{{- end }}
